"""Every example of every page runs, in order, in a folder with the repository's examples and tiny data."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import refine.refiner
from nets.checkpoint import Record, load_model, save_model
from nets.color import linear_to_srgb
from nets.data.pool_format import from_planes
from nets.data.procedural import generate
from nets.generator import Generator, GeneratorConfig
from nets.render import Camera, PointLight, render
from refine.cli import SUBCOMMANDS
from tests.docs.examples import PAGES, ROOT, commands, read_examples, spoken_commands
from tests.docs.shell import TINY_NETWORK, run
from tests.e2e.pictures import save_picture
from tests.eval_files import material, write_surface
from tests.test_readme import MODULES, offered
from tests.training_files import STAGES, write_pairs, write_plan, write_strips

FLASHES = PointLight(
    torch.tensor([[0.0, 0.1, 3.0], [0.9, 0.1, 2.9], [-0.8, -0.2, 3.1]]), torch.ones(3, 3), "inverse_square"
)


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of what examples are about: a network, photos of one surface, strips, pairs, a plan."""
    folder = tmp_path_factory.mktemp("inputs")
    config = GeneratorConfig(width=2, levels=7, deep_multiplier=2)
    save_model(folder / TINY_NETWORK, Generator(config), Record(config))
    shutil.copytree(ROOT / "configs", folder / "configs")
    shutil.copytree(ROOT / "examples", folder / "examples")
    shutil.copy(ROOT / "examples" / "slate.jpg", folder / "photo.jpg")
    surface = from_planes(generate("leather", 64, 3)).map(lambda tensor: tensor[..., :24])
    for name, photo in zip("abc", render(surface, FLASHES, Camera("collocated")), strict=True):
        pixels = linear_to_srgb(photo[None].clamp(max=1.0))[0].permute(1, 2, 0).numpy()
        (folder / "surface").mkdir(exist_ok=True)
        save_picture(folder / "surface" / f"{name}.png", np.ascontiguousarray(pixels))
    write_strips(folder / "strips", 3, size=80)
    write_surface(folder / "surfaces" / "wall", material(0), "calib.json")
    write_pairs(folder / "pairs")
    once = [{"iterations": 1, "crop": 16, "batch": 2}]
    write_plan(
        folder / "tiny.yaml",
        *({**STAGES[name], "phases": once} for name in ("l1", "syn", "light")),
        {**STAGES["hyb"], "name": "hyb0", "phases": once},
        *({**STAGES["syn"], "name": name, "phases": once} for name in ("revise", "relief")),
        {**STAGES["hyb"], "phases": once},
    )
    return folder


@pytest.fixture
def here(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the inputs as the current folder; shipped names of networks mean the tiny one."""
    folder = tmp_path / "here"
    shutil.copytree(inputs, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    tiny = load_model(TINY_NETWORK)
    monkeypatch.setattr(
        refine.refiner, "load_model", lambda name: tiny if name == "default" else load_model(name)
    )
    return folder


def run_python(text: str, names: dict[str, object], page: str) -> None:
    """Run a Python example in the names that the page's examples before it left."""
    exec(compile(re.sub(r"iters=\d+", "iters=2", text), page, "exec"), names)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```" in page.read_text(encoding="utf-8")], ids=lambda path: path.stem
)
def test_the_examples_of_a_page_run(
    page: Path, here: Path, unchecked: None, capsys: pytest.CaptureFixture[str]
) -> None:
    examples = read_examples(page.read_text(encoding="utf-8"))
    threads = torch.get_num_threads()
    names: dict[str, object] = {}
    try:
        for example in examples:
            if example.left_out is not None:
                continue
            if example.language == "python":
                run_python(example.text, names, page.name)
                continue
            for words in commands(example.text):
                run(words)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_commands_in_the_text_know_their_options(page: Path) -> None:
    for words in spoken_commands(page.read_text(encoding="utf-8")):
        if words[:2] == ["python", "-m"]:
            module = words[2]
        elif words[0] == "refine" and words[1:] and words[1] in SUBCOMMANDS:
            module = SUBCOMMANDS[words[1]].partition(":")[0]
        elif words[0] in MODULES:
            module = MODULES[words[0]]
        else:
            continue
        own = words[: words.index("--")] if "--" in words else words  # what follows is no option's name
        used = {word.partition("=")[0] for word in own if word.startswith("--")}
        assert used <= offered(module) | {"--help"}, " ".join(words)


def test_the_reader_of_examples_sees_what_is_said() -> None:
    page = (
        "<!-- run with\na => b\na/c => d\n-->\n```sh\nx a a/c && y \\\n  z  # no\n```\n"
        "```python\n1\n```\n<!-- not run: slow -->\n```sh\nw\n```\n```\nprose\n```\n"
    )
    first, second, third = read_examples(page)
    assert commands(first.text) == [["x", "b", "d"], ["y", "z"]]
    assert (second.language, second.text, second.left_out) == ("python", "1\n", None)
    assert third.left_out == "slow"


@pytest.mark.parametrize("comment", ["<!-- not run: -->", "<!-- run with\nq => r\n-->"])
def test_a_comment_that_says_nothing_is_refused(comment: str) -> None:
    with pytest.raises(ValueError, match=r"says nothing|is not in"):
        read_examples(f"{comment}\n```sh\nx\n```\n")
