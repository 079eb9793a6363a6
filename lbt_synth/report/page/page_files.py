"""Pages as files: HTML, and PDF if that is wanted."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from lbt_synth.errors import MissingExtraError
from lbt_synth.report.page.blocks import Page
from lbt_synth.report.page.html import page_html
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_together
from lbt_synth.storage.warning_filters import ignore_warnings

_SCRIPT = re.compile(r"<script.*?</script>", re.DOTALL)


def require_page_names(
    path: str | os.PathLike[str],
    pdf: str | os.PathLike[str] | None = None,
    *,
    inputs: tuple[str | os.PathLike[str], ...] = (),
) -> None:
    """Refuse names of pages that cannot be written, or would replace an input."""
    pages: list[tuple[str | os.PathLike[str], str]] = [(path, ".html")]
    if pdf is not None:
        pages.append((pdf, ".pdf"))
    for name, ending in pages:
        require_ending(name, "a page", (ending,))
    require_writable(*(name for name, _ in pages), inputs=inputs)
    if pdf is not None:
        require_weasyprint()


def write_page(
    page: Page, path: str | os.PathLike[str], pdf: str | os.PathLike[str] | None = None
) -> tuple[Path, ...]:
    """Write a page as HTML, and as PDF if that is named; all files are written, or none."""
    contents: dict[str | os.PathLike[str], bytes] = {path: page_html(page)}
    if pdf is not None:
        contents[pdf] = print_html(contents[path])
    return write_together(contents)


def print_html(html: bytes) -> bytes:
    """Return a page of HTML on sheets of A4, as PDF; its scripts draw nothing on paper."""
    text = _SCRIPT.sub("", html.decode())
    content: bytes = require_weasyprint().HTML(string=text).write_pdf()
    return content


def require_weasyprint() -> Any:
    """Return the module that prints HTML."""
    try:
        with ignore_warnings(DeprecationWarning):  # of a library that it will need later
            import weasyprint
    except (ImportError, OSError) as error:  # OSError: without the library Pango
        raise MissingExtraError(
            'a page as PDF needs WeasyPrint and Pango: pip install "lbt-synth[pdf]", and on Debian '
            "apt-get install libpango-1.0-0 libpangoft2-1.0-0.",
            extra="pdf",
        ) from error
    return weasyprint
