"""Pages as files: HTML, and PDF if that is wanted."""

from __future__ import annotations

import os
from pathlib import Path

from lbt_synth.report.page.blocks import Page
from lbt_synth.report.page.html import page_html
from lbt_synth.report.page.pdf import page_pdf
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_together


def require_page_names(
    path: str | os.PathLike[str],
    pdf: str | os.PathLike[str] | None = None,
    *,
    inputs: tuple[str | os.PathLike[str], ...] = (),
) -> None:
    """Refuse names of pages that cannot be written, or would replace an input."""
    given: list[tuple[str | os.PathLike[str], str]] = [(path, ".html")]
    if pdf is not None:
        given.append((pdf, ".pdf"))
    for name, ending in given:
        require_ending(name, "a page", (ending,))
    require_writable(*(name for name, _ in given), inputs=inputs)


def write_page(
    page: Page, path: str | os.PathLike[str], pdf: str | os.PathLike[str] | None = None
) -> tuple[Path, ...]:
    """Write a page as HTML, and as PDF if that is named; all files are written, or none."""
    contents: dict[str | os.PathLike[str], bytes] = {path: page_html(page)}
    if pdf is not None:
        contents[pdf] = page_pdf(page)
    return write_together(contents)
