"""The certificate that goes beside every exported file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lbt_synth.design import Check
from lbt_synth.interop.arithmetic_cost import FrameCost
from lbt_synth.interop.export_checks import Exported
from lbt_synth.interop.target import CERTIFICATE, Arithmetic
from lbt_synth.loop.simulation.run import SteppedController
from lbt_synth.storage.atomic_files import write_together
from lbt_synth.storage.rows import json_record


def write_export(
    files: dict[Path, bytes],
    *,
    target: str,
    arithmetic: Arithmetic,
    checks: Sequence[Check],
    gain_digest: str | None,
    error: float,
    start: Callable[[float], SteppedController],
    error_single: float | None = None,
    cost: FrameCost | None = None,
    **facts: Any,
) -> Exported:
    """Write files and their certificate, named after the first file; all or none.

    ``facts`` are what else the files depend on. Without another one, the error is that of single
    precision.
    """
    digests = {path.name: hashlib.sha256(data).hexdigest() for path, data in files.items()}
    first, *others = files
    certificate: dict[str, Any] = {
        "target": target,
        "file": first.name,
        "file_sha256": digests[first.name],
        **({"others_sha256": {o.name: digests[o.name] for o in others}} if others else {}),
        "gain_sha256": gain_digest,
        **facts,
        "arithmetic": json_record(arithmetic),
        "checks": [json_record(check) for check in checks],
    }
    text = json.dumps(certificate, indent=2, allow_nan=False) + "\n"
    written = (*files.items(), (first.with_name(first.name + CERTIFICATE), text.encode()))
    return Exported(
        files=write_together(dict(written)),
        error=error,
        error_single=error if error_single is None else error_single,
        start=start,
        checks=tuple(checks),
        cost=cost,
    )
