"""Gain files of designs, changed by hand."""

import json

import numpy as np

import lbt_synth as lbt
from lbt_synth.storage.array_file import digest, npz_bytes, read_npz


def edited_file(path, design, change, *, digest_again=True):
    """The NPZ gain file of a design after a change of its ``arrays`` (as lists) and ``meta``."""
    arrays, text = read_npz(lbt.save_gain(path, design).read_bytes())
    document = {"arrays": {k: v.tolist() for k, v in arrays.items()}, "meta": json.loads(text)}
    change(document)
    arrays = {k: np.array(v, dtype=float) for k, v in document["arrays"].items()}
    if digest_again:
        document["meta"]["digest"] = digest(arrays, document["meta"])
    path.write_bytes(npz_bytes(arrays, json.dumps(document["meta"])))
    return path
