"""`refine view FOLDER ...`: a page that shows materials under a light one can move."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from refine.errors import UserError
from refine.files import write_text_atomically

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich")


@app.command()
def view(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER...", help="Of results", show_default=False)
    ],
    html: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the page instead of showing it", show_default=False),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only say where the page is", show_default=False)
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print nothing but errors", show_default=False)
    ] = False,
) -> None:
    """Show materials under a light you can move.

    FOLDERs are what refine wrote. The page is served to this machine alone
    until Ctrl-C; with --html it is one file that needs no network.
    Example: refine view wall_material leather_material --html gallery.html
    """
    if html is not None and html.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"--html {html} is not the name of a page; end it in .html.")

    from refine.viewer.page import build_page
    from refine.viewer.serve import address, page_server

    page = build_page(folders)
    if html is not None:
        write_text_atomically(html, page)
        if not quiet:
            print(f"wrote {html} ({len(page) / 1e6:.1f} MB)", file=sys.stderr)
        return
    with page_server(page) as server:
        if not quiet:
            print(f"the page is at {address(server)}; Ctrl-C ends it", file=sys.stderr)
        if not no_browser:
            webbrowser.open(address(server))
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return
