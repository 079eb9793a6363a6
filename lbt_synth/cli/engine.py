"""What runs the cases of a command: processes of this machine, or a Dask cluster."""

from __future__ import annotations

from argparse import Namespace
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext

from lbt_synth.errors import ProblemError
from lbt_synth.studies.study.cluster import connect_cluster


def require_jobs(arguments: Namespace) -> None:
    """Refuse a number of processes that is not above 0."""
    if arguments.jobs < 1:
        raise ProblemError(f"--jobs must be at least 1; got {arguments.jobs}.")


def choose_engine(
    arguments: Namespace,
) -> AbstractContextManager[tuple[Executor | None, int | None]]:
    """Provide the executor of ``--dask`` and its workers, or None for both with ``--jobs``."""
    if arguments.dask is None:
        if arguments.dask_tls is not None:
            raise ProblemError("--dask-tls goes with --dask.")
        return nullcontext((None, None))
    return connect_cluster(arguments.dask, tls=arguments.dask_tls)
