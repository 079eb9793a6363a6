"""The JSON schema of a configuration, with which editors complete and check its keys."""

from __future__ import annotations

from typing import Any

from lbt_synth.config.schema import FileSection


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file.

    Every key has its description, with its unit. Rules over several keys, such as one of
    ``rms_nm`` and ``rms_mas``, are known to :func:`load_config` alone.

    Returns
    -------
    dict
        Schema of draft 2020-12, ready for :func:`json.dumps`.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> schema = lbt.config.config_schema()
    >>> schema["$defs"]["LoopSection"]["properties"]["frame_rate_hz"]["description"]
    'frame rate [Hz]'
    """
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **FileSection.model_json_schema(), "title": "lbt-synth"}
