"""A page that shows the results of a batch: thumbnails with links to their files, and what failed.

Names, paths and reasons reach the page as text only, escaped. The policy lets in its one style sheet and the
pictures beside it: no script, nothing from a network.
"""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Mapping, Sequence
from importlib.resources import files
from string import Template
from typing import Any
from urllib.parse import quote

from refine.batch.plan import Job, read_record


def build_index(jobs: Sequence[Job], outcomes: Mapping[Job, str | None]) -> str:
    """Return the HTML of the index.

    Args:
        jobs: all photos of the batch.
        outcomes: of those that were tried: why one failed, None if it is done.
    """
    done = [job for job in jobs if job in outcomes and outcomes[job] is None]
    failed = {job: reason for job in jobs if (reason := outcomes.get(job)) is not None}
    counts = [f"{len(done)} done", f"{len(failed)} failed", f"{len(jobs) - len(done) - len(failed)} to do"]
    style = _text("index.css")
    page = Template(_text("index.html")).substitute(
        policy=content_security_policy(style),
        style=style,
        counts=" · ".join(count for count in counts if not count.startswith("0 ")) or "no photos",
        failures=_failures(failed),
        cards="\n".join(_card(job) for job in done),
    )
    return page.encode("utf-8", "replace").decode("utf-8")  # names of files need not be valid text


def content_security_policy(style: str) -> str:
    """Return the policy under which nothing but this style sheet and pictures beside the page are loaded."""
    digest = base64.b64encode(hashlib.sha256(style.encode("utf-8")).digest()).decode("ascii")
    return (
        f"default-src 'none'; img-src 'self' file:; style-src 'sha256-{digest}'; "
        "base-uri 'none'; form-action 'none'"
    )


def _failures(failed: Mapping[Job, str]) -> str:
    if not failed:
        return ""
    rows = "\n".join(
        f"<dt>{html.escape(job.source)}</dt><dd>{html.escape(reason)}</dd>" for job, reason in failed.items()
    )
    return f"<section><h2>Failed</h2>\n<dl>\n{rows}\n</dl></section>"


def _card(job: Job) -> str:
    record = read_record(job) or {}
    names = record["maps"]["files"]
    links = {"report": "report", "rendering": "rendering", "json": "record"}
    shown = [
        f'<a href="{_address(job, names[name])}">{word}</a>' for name, word in links.items() if name in names
    ]
    target = _address(job, names.get("report", names["rendering"]))
    source = _address(job, names["thumbnail"])
    picture = f'<img src="{source}" width="576" height="192" alt="" loading="lazy">'
    return (
        f'<article><a class="picture" href="{target}">{picture}</a>\n'
        f"<h2>{html.escape(job.name)}</h2>\n<p>{html.escape(_facts(record))}</p>\n"
        f"<nav>{' '.join(shown)}</nav></article>"
    )


def _facts(record: Mapping[str, Any]) -> str:
    maps, rmse = record["maps"], record["rmse"]
    error = " → ".join(
        "unknown" if rmse[name] is None else f"{rmse[name]:.4f}" for name in ("initialization", "refined")
    )
    return f"{maps['width']} x {maps['height']}, re-rendering RMSE {error}"


def _address(job: Job, name: str) -> str:
    """The address of a file of a result, seen from the index."""
    return html.escape(quote(f"{job.name}/{name}", errors="surrogateescape"))


def _text(name: str) -> str:
    return (files("refine.batch") / name).read_text(encoding="utf-8")
