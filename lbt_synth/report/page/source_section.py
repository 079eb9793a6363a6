"""The last section of a page: the files and programs that it was made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from lbt_synth.report.page.blocks import Listing, Section
from lbt_synth.report.provenance import SourceFile, program_versions
from lbt_synth.storage.rows import row_table
from lbt_synth.storage.tables import Table


def source_section(
    files: Sequence[SourceFile] = (),
    *,
    versions: Sequence[tuple[str, str]] | None = None,
    texts: Mapping[str, str] = MappingProxyType({}),
    about: Table | None = None,
) -> Section:
    """Return the last section of a page: what it was made from, and by which programs.

    Texts are listed under their captions.
    """
    made_with = tuple(program_versions() if versions is None else versions)
    return Section(
        key="sources",
        title="Files and versions",
        blocks=(
            *([] if about is None else [about]),
            *([row_table("Files that were read", files)] if files else []),
            Table(caption="Made with", headings=("program", "version"), rows=made_with, words=(1,)),
            *(Listing(caption=caption, text=text) for caption, text in texts.items()),
        ),
    )
