"""What runs a study: processes of this machine, or a Dask cluster. Nothing else imports Dask."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import lbt_synth
from lbt_synth.cli.streams import count_progress, print_error
from lbt_synth.errors import MissingExtraError, ProblemError
from lbt_synth.storage.atomic_files import make_directory
from lbt_synth.storage.thread_limits import WorkerPool, limit_threads
from lbt_synth.validation import integer

_TIMEOUT_S = 10  # for a scheduler of Dask and its first worker to answer


def choose_engine(
    arguments: Namespace,
) -> AbstractContextManager[tuple[Executor | None, int | None]]:
    """Provide the executor of ``--dask`` or of ``--jobs`` with its workers; None for one job."""
    dask, tls = (getattr(arguments, name, None) for name in ("dask", "dask_tls"))
    if dask is not None:
        return connect_cluster(dask, tls=tls)
    if tls is not None:
        raise ProblemError("--dask-tls goes with --dask.")
    return nullcontext((None, None)) if arguments.jobs == 1 else _start_processes(arguments.jobs)


@contextmanager
def _start_processes(jobs: int) -> Iterator[tuple[Executor, int]]:
    """Provide processes with one thread each, which end at once if the block fails."""
    integer(jobs, "--jobs", at_least=1, at_most=8 * (os.cpu_count() or 1))
    with limit_threads(), WorkerPool(jobs) as pool:
        yield pool, jobs


@contextmanager
def run_in_parts(
    arguments: Namespace, folder: Path, *, total: int, what: str
) -> Iterator[dict[str, Any]]:
    """Provide the executor, its workers and a progress bar for work that resumes from a folder.

    An interruption says where what is finished stays.
    """
    with (
        choose_engine(arguments) as (executor, workers),
        count_progress(total=total, what=what) as count,
    ):
        make_directory(folder)
        try:
            yield {"executor": executor, "workers": workers, "progress": count}
        except KeyboardInterrupt:
            print_error(f"what is finished is kept in {folder}; start it again to continue")
            raise


@contextmanager
def connect_cluster(
    address: str, *, tls: Sequence[str] | None = None
) -> Iterator[tuple[Executor, int]]:
    """Provide the executor of a Dask scheduler with this package, and how many threads it has.

    A scheduler can run code on its clients: name only one that you trust. ``tls`` names the
    files of the authority, of the certificate and of the key of an encrypted connection.
    """
    try:
        from distributed import Client
        from distributed.security import Security
    except ImportError as error:
        raise MissingExtraError(
            '--dask needs dask.distributed; try: pip install "lbt-synth[dask]".', extra="dask"
        ) from error
    names = ("tls_ca_file", "tls_client_cert", "tls_client_key")
    try:
        files = dict(zip(names, tls, strict=True)) if tls else {}
        security = Security(**files, require_encryption=True if tls else None)
        client: Any = Client(address, timeout=_TIMEOUT_S, set_as_default=False, security=security)
    except (OSError, ValueError, TypeError) as error:
        text = " ".join(str(error).split()) or "no answer"
        raise ProblemError(
            f"no Dask scheduler answers at {address!r} ({text.rstrip('.')}). Expected an address "
            "such as tcp://host:8786; start one with dask scheduler, and dask worker."
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_TIMEOUT_S)
        except TimeoutError as error:
            raise ProblemError(
                f"the scheduler at {address} has no workers; start some with dask worker {address}."
            ) from error
        _require_versions(address, client)
        yield client.get_executor(pure=False), sum(client.ncores().values())


def _require_versions(address: str, client: Any) -> None:
    """Refuse workers without this version, whose results would be others."""
    hosts = client.get_versions(packages=["lbt_synth"])["workers"]
    versions = {host["packages"].get("lbt_synth") or "none" for host in hosts.values()}
    if versions != {lbt_synth.__version__}:
        raise ProblemError(
            f"all workers must have lbt_synth {lbt_synth.__version__}, as here; those of {address} "
            f"have {', '.join(sorted(versions))}. Start them from the same environment."
        )
