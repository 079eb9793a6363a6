"""What is wrong with the commands of a record, by their verdict and by their law."""

from __future__ import annotations

from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.identification.commands.verdict import CommandVerdict
from lbt_synth.storage.rows import column, table_row

_FIND = "find the commands that belong to these measurements"


@table_row
class CommandRow:
    """How the commands of a record reach its measurements."""

    explanation: str = column("the commands", help="What explains the record best")
    nats: float = column(
        "evidence", format=".0f", help="Log-likelihood over that of the record as given"
    )
    repair: str = column("repair", help="Options that repair the record")


def command_row(verdict: CommandVerdict) -> CommandRow:
    """Return the verdict on the commands as a row."""
    return CommandRow(
        explanation=verdict.explanation,
        nats=verdict.nats,
        repair=verdict.options,
    )


def doubt_commands(verdict: CommandVerdict | None) -> tuple[str, str]:
    """Say what is wrong with the commands, and what to do; empty if nothing is."""
    if verdict is None:
        return "", ""
    if not verdict.accepted:
        if verdict.options:
            return verdict.explanation, f"read the record with {verdict.options}"
        what, _, advice = verdict.explanation.partition(". ")
        return what, advice[:1].lower() + advice[1:] or _FIND
    return ("", "") if verdict.law is None else _doubt_law(verdict.law)


def _doubt_law(law: ControlLaw) -> tuple[str, str]:
    """Say what is wrong by the law alone, for records too short for anything else."""
    matrix = law.axis_matrix
    if not law.exact:
        return "", ""
    if matrix.kind == "diagonal" and min(matrix.signs) < 0:
        return "by their law they have the opposite sign", "turn their sign"
    if matrix.kind == "swapped":
        return "by their law those of the two axes are exchanged", "exchange them"
    if law.kind == "proportional":
        return "by their law they are increments, not positions", "add them up"
    return "", ""
