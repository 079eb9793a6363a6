"""Gain files as one JSON object: arrays and metadata, to bytes and back."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from lbt_synth.validation import FloatArray


def write_json(arrays: Mapping[str, FloatArray], text: str) -> bytes:
    """Write one JSON object; numbers keep all their digits."""
    document = {"meta": json.loads(text), "arrays": {k: v.tolist() for k, v in arrays.items()}}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def read_json(content: bytes) -> tuple[dict[str, FloatArray], str]:
    """Read the arrays and the text of :func:`write_json`; other bytes raise some exception."""
    document = json.loads(content.decode())
    if not isinstance(document, dict):
        raise ValueError("the JSON is not an object")  # noqa: TRY004 - one kind of refusal
    arrays = {k: np.array(v, dtype=np.float64) for k, v in document["arrays"].items()}
    return arrays, json.dumps(document["meta"])
