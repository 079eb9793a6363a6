"""Files are never written over an input."""

from __future__ import annotations

from pathlib import Path

import pytest

from lbt_synth.errors import OutputError
from lbt_synth.storage.atomic_files import refuse_replacing, require_writable


def test_what_is_not_there_or_no_name_is_no_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.fits").write_bytes(b"a")
    refuse_replacing(["b.fits", "\0"], ["a.fits", "none.fits", "\0c"])
    Path("ring").symlink_to("ring")
    refuse_replacing(["b.fits"], ["ring"])
    require_writable("b.fits", inputs=["a.fits"])
    with pytest.raises(OutputError, match=r"a\.fits must not replace the input \./a\.fits") as one:
        require_writable("a.fits", inputs=["./a.fits"])
    assert one.value.path == Path("a.fits")
    with pytest.raises(OutputError, match="must not replace"):  # before either exists
        refuse_replacing(["none.fits"], [tmp_path / "x" / ".." / "none.fits"])
