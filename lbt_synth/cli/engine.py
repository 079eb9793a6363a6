"""What runs the cases of a command: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

from lbt_synth.cli.argument_kinds import option_name
from lbt_synth.cli.streams import print_error
from lbt_synth.errors import ProblemError
from lbt_synth.studies.study.cluster import connect_cluster
from lbt_synth.validation import integer


def require_counts(arguments: Namespace, *names: str) -> None:
    """Refuse options that count something, such as ``jobs``, below 1."""
    for name in names:
        integer(getattr(arguments, name), option_name(name), at_least=1)


def choose_engine(
    arguments: Namespace,
) -> AbstractContextManager[tuple[Executor | None, int | None]]:
    """Provide the executor of ``--dask`` and its workers, or None for both with ``--jobs``."""
    if arguments.dask is None:
        if arguments.dask_tls is not None:
            raise ProblemError("--dask-tls goes with --dask.")
        return nullcontext((None, None))
    return connect_cluster(arguments.dask, tls=arguments.dask_tls)


@contextmanager
def keep_finished(folder: Path) -> Iterator[None]:
    """Say where what is finished stays if the user interrupts the rest."""
    try:
        yield
    except KeyboardInterrupt:
        print_error(f"what is finished is kept in {folder}; start it again to continue")
        raise
