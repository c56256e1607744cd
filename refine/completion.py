"""`refine completion SHELL`: the script with which a shell completes `refine`, and the answers it asks for.

The script calls `refine completion SHELL -- WORD...` at every press of Tab, so nothing heavy is imported:
names that heavy modules know are written down here, and the tests compare. The last word is being typed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer.main import get_command

from refine.arguments import CameraKind, choose
from refine.engine import ENGINES
from refine.export.cli import FORMATS
from refine.export.targets import TARGETS

NAMES: dict[str, tuple[str, ...]] = {
    "--falloff": ("none", "inverse_square", "auto"),
    "--camera": get_args(CameraKind),
    "--color-space": ("auto", "srgb", "linear", "gamma22", "display-p3", "adobe-rgb"),
    "--recipe": ("default", "paper", "several", "fast", "gao", "gao+"),
    "--engine": ("auto", *ENGINES),
    "--format": ("png", "png8", "tif", "tif8", "tif32", "exr", "exr32"),
    "--normals": ("opengl", "directx"),
    "--device": ("cpu", "cuda", "mps"),
    "export --format": FORMATS,
}
"""What options take, those of `refine` by their name, those of a command after the command's."""

LISTS = ("--to", "--export")
"""Options that take targets, separated by commas."""

SCRIPTS = {
    "bash": """\
_refine() {
    local IFS=$'\\n' word=${COMP_WORDS[COMP_CWORD]}
    [[ $word == = ]] && word=
    COMPREPLY=($(refine completion bash -- "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
    # A photo may stand where a command may.
    [[ $COMP_CWORD -gt 1 || $word == -* ]] || COMPREPLY+=($(compgen -f -- "$word"))
}
complete -o filenames -o default -F _refine refine
""",
    "zsh": """\
#compdef refine
_refine() {
    local -a answers
    answers=("${(@f)$(refine completion zsh -- "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    [[ -n $answers ]] && _describe 'refine' answers
    (( CURRENT > 2 )) && [[ -n $answers ]] || _files
}
compdef _refine refine
""",
    "fish": """\
function __refine_answers
    refine completion fish -- (commandline -opc)[2..-1] (commandline -ct) 2>/dev/null
end
complete -c refine -a '(__refine_answers)'
""",
}

Answer = tuple[str, str]
"""A word and its help, which may be empty."""

LINES: dict[str, Callable[[Answer], str]] = {
    "bash": lambda answer: answer[0],
    "zsh": lambda answer: ":".join(part.replace(":", r"\:") for part in answer if part),
    "fish": lambda answer: "\t".join(part for part in answer if part),
}
"""How a shell reads an answer."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")


@app.command()
def completion(
    shell: Annotated[str, typer.Argument(metavar="SHELL", help=", ".join(SCRIPTS), show_default=False)],
    words: Annotated[list[str] | None, typer.Argument(hidden=True)] = None,
) -> None:
    """Print the script that completes refine in a shell: commands, options, names.

    Example: refine completion bash > ~/.local/share/bash-completion/completions/refine
    """
    choose("SHELL", shell, tuple(SCRIPTS))
    if not words:
        print(SCRIPTS[shell], end="")
        return
    for answer in answers(words):
        print(LINES[shell](answer))


def answers(words: Sequence[str]) -> list[Answer]:
    """Return what the last word may become; nothing where a file, a number or anything else may stand.

    Args:
        words: of the command line after `refine`, the last one perhaps begun, perhaps empty.
    """
    from refine.cli import SUBCOMMANDS

    *before, typed = ("" if word == "=" else word for word in words)  # bash takes --name=value apart
    before = [word for word in before if word]
    command = before.pop(0) if before and before[0] in SUBCOMMANDS else ""
    options = _options(command)
    name, equals, value = typed.partition("=")
    if equals and name in options:
        return [(f"{name}={whole}", "") for whole in _values(command, name, value)]
    if before and before[-1] in options and not options[before[-1]].is_flag:
        return [(whole, "") for whole in _values(command, before[-1], typed)]
    if typed.startswith("-"):
        fresh = {name: option.help or "" for name, option in options.items() if name not in before}
        return [item for item in {**fresh, "--help": "Show help"}.items() if item[0].startswith(typed)]
    if before:
        return []
    names = {"": SUBCOMMANDS, "completion": SCRIPTS}.get(command, {})
    return [(name, "") for name in names if name.startswith(typed)]


def _options(command: str) -> dict[str, Any]:
    from refine.cli import SUBCOMMANDS

    module, _, attribute = SUBCOMMANDS.get(command, "refine.cli:app").partition(":")
    parameters = get_command(getattr(import_module(module), attribute)).params
    return {name: one for one in parameters for name in one.opts if name.startswith("--")}


def _values(command: str, name: str, typed: str) -> Iterator[str]:
    """Yield what may follow an option and begins as what was typed."""
    chosen, comma, _ = typed.rpartition(",")
    known: Sequence[str] = NAMES.get(f"{command} {name}", NAMES.get(name, ()))
    if name in LISTS:
        known = [f"{chosen}{comma}{target}" for target in TARGETS if target not in chosen.split(",")]
    elif name == "--init":
        known = _networks()
    yield from (whole for whole in known if whole.startswith(typed))


def _networks() -> list[str]:
    """Return the shipped networks' names without importing `nets`, which would import torch."""
    found = find_spec("nets")
    folders = found.submodule_search_locations if found else None
    return sorted(
        file.stem for folder in folders or [] for file in Path(folder).glob("weights/*.safetensors")
    )
