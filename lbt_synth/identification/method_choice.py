"""The method of synthesis for a record, chosen by what it leaves of the frames after its training.

The simplest choice is the default method. It stays unless another one leaves less by more than
twice the standard error of the difference on the same frames: the rule of one error for the
simplest of several equal models (L. Breiman, J. H. Friedman, R. A. Olshen, C. J. Stone,
Classification and Regression Trees (1984), section 3.4.3), with two errors, because of several
methods of equal merit some one is often better by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.forward_chaining import (
    ForwardSplit,
    compare_on_splits,
    forward_split,
    record_splits,
)
from lbt_synth.identification.prediction.paired_residuals import PairedResiduals
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.methods.registry import default_method, method_named, record_methods
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row

_SPLITS = 2
_ERRORS = 2.0  # of the difference by which another method has to leave less than the default
_LEAST_SHARE = 1e-3  # of the measured variance: below, a difference is of no use or rounding


@table_row
class MethodRow:
    """A method of synthesis on the frames after its training."""

    name: str = column("method", help="What it is")
    residual_nm: float = nm_column(
        "residual", format=".2f", help="Residual on these frames, all axes"
    )
    above_nm2: float = column(
        "above the chosen", unit="nm^2", format=".4g", help="Its variance above that of the chosen"
    )
    above_error_nm2: float = column(
        "+-", unit="nm^2", format=".2g", help="Standard error of the difference"
    )
    above: float = percent_column(
        "of the measured variance", help="The same over what the loop of the chosen one measures"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MethodChoice:
    """The method of synthesis chosen for a record.

    Attributes
    ----------
    method : str
        Its name.
    rows : tuple of MethodRow
        The methods, from the least measured residual; empty if they could not be compared.
    notes : tuple of str
        By how much the chosen one is better, and why others are left out.
    """

    method: str
    rows: tuple[MethodRow, ...]
    notes: tuple[str, ...]


def quick_methods() -> list[str]:
    """Return the names of the methods that an automatic choice tries."""
    return [name for name in record_methods() if not method_named(name).slow]


def choose_method(
    record: LoopRecord,
    half: IdentifiedModel,
    *,
    identify_past: Callable[..., IdentifiedModel],
    design: Callable[[str, IdentifiedModel, Mapping[str, Any]], Design],
    is_safe: Callable[[Design], bool],
) -> MethodChoice:
    """Choose the default method, unless another one leaves clearly less in forward chaining.

    ``half`` is identified from the training of the first of the two splits, half of the usable
    frames, and ``identify_past`` takes its ``stretches=`` and ``start=``. ``is_safe`` says whether
    the loop of a design is stable at all sensor gains that the record allows, and is asked only of
    a method that would replace the default. A method that fails or is unstable is left out; if
    nothing can be compared, a note says why.
    """

    def build(name: str, split: ForwardSplit) -> Design:
        return design(name, split.model, method_named(name).reference_options)

    def splits() -> Iterator[ForwardSplit]:
        for i, (training, test) in enumerate(record_splits(record, _SPLITS)):
            past = half if i == 0 else identify_past(stretches=training, start=half)
            yield forward_split(record, training, test, model=past)

    tried = {name: partial(build, name) for name in quick_methods()}
    try:
        chain = compare_on_splits(splits(), tried)
    except LbtSynthError as error:
        note = f"the methods were not compared: {error}"
        return MethodChoice(method=default_method(), rows=(), notes=(note,))
    chosen, failures = default_method(), dict(chain.failures)
    for name in _better_methods(chain.residuals):
        if is_safe(design(name, half, method_named(name).reference_options)):
            chosen = name
            break
        failures[name] = "its loop is unstable at a sensor gain that the record allows"
    return _describe_choice(chosen, chain.residuals, failures)


def _better_methods(residuals: PairedResiduals) -> list[str]:
    """Return the methods that leave clearly less than the default, the best first."""
    usual = default_method()
    if usual not in residuals.squares_nm2:
        return list(residuals.names)
    return [name for name in residuals.names if _is_better(residuals, name, usual)]


def _is_better(residuals: PairedResiduals, name: str, other: str) -> bool:
    difference, error = residuals.above(other, name)
    return difference > max(_ERRORS * error, _LEAST_SHARE * residuals.measured_nm2(other))


def _describe_choice(
    chosen: str, residuals: PairedResiduals, failures: Mapping[str, str]
) -> MethodChoice:
    """Return the choice with its table, and say by how much it is better."""
    title, usual = method_named(chosen).title, default_method()
    notes = [
        f"the {method_named(name).title} is left out: {why.rstrip('.')}"
        for name, why in failures.items()
    ]
    shown = [name for name in residuals.names if name not in failures]
    if chosen not in shown:
        return MethodChoice(method=chosen, rows=(), notes=tuple(notes))
    rows = []
    for name in shown:
        difference, error = residuals.above(name, chosen)
        left = residuals.residual_nm2(name)
        rows.append(
            MethodRow(
                name=method_named(name).title,
                residual_nm=float(np.sqrt(left)) if left > 0 else float("nan"),
                above_nm2=difference,
                above_error_nm2=error,
                above=difference / residuals.measured_nm2(chosen),
            )
        )
    if chosen == usual:
        word = (
            f"the {title} stays: of the frames after its training no method tried leaves less by "
            f"more than {_ERRORS:g} standard errors of the difference"
        )
    elif usual in shown:
        difference, error = residuals.above(usual, chosen)
        share = difference / residuals.measured_nm2(usual)
        word = (
            f"the {title} is chosen: of the frames after its training it leaves less than the "
            f"{method_named(usual).title}, by {nm_text(difference, error_nm=error, unit='nm^2')} "
            f"({100 * share:.2g} % of the measured variance)"
        )
    else:
        word = f"the {title} is chosen: of the methods that are left it leaves least"
    return MethodChoice(method=chosen, rows=tuple(rows), notes=(word, *notes))
