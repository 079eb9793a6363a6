"""Results and failures of a batch of samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A controller without a result on a sample.

    Attributes
    ----------
    row : int
        The sample, from 0.
    controller : str
        Name of the controller.
    error : str
        What went wrong.
    retry : bool
        Whether it is tried again when the study is started again: its process died, which need
        not be the sample's fault.
    """

    row: int
    controller: str
    error: str
    retry: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BatchResult:
    """Results of consecutive samples.

    Attributes
    ----------
    start : int
        Row of the first sample.
    columns : mapping of str to (b,) ndarray
        Results by column, one of ``Study.result_columns``; nan without a result.
    failures : tuple of Failure
        In the order of their rows.
    """

    start: int
    columns: Mapping[str, FloatArray]
    failures: tuple[Failure, ...] = ()
