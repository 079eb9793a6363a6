"""Connection to a Dask cluster, the only module that imports dask.distributed."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import lbt_synth
from lbt_synth.errors import MissingExtraError, ProblemError

_TIMEOUT_S = 10


@contextmanager
def connect_cluster(address: str) -> Iterator[tuple[Executor, int]]:
    """Provide the executor of a Dask scheduler with this package, and how many threads it has."""
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise MissingExtraError(
            '--dask needs dask.distributed; try: pip install "lbt-synth[dask]".', extra="dask"
        ) from error
    try:
        # a client made with an invalid address complains again when it is collected
        get_address_host_port(address if "://" in address else f"tcp://{address}", strict=True)
        client: Any = Client(address, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError
        text = " ".join(str(error).split()) or "no answer"
        raise ProblemError(
            f"no Dask scheduler answers at {address!r} ({text.rstrip('.')}). Expected an address "
            "such as tcp://host:8786; start one with dask scheduler, and dask worker."
        ) from error
    with _silence_logging(), client:
        try:
            client.wait_for_workers(1, timeout=_TIMEOUT_S)
        except TimeoutError as error:
            raise ProblemError(
                f"the scheduler at {address} has no workers; start some with dask worker {address}."
            ) from error
        _require_versions(address, client)
        yield client.get_executor(pure=False), sum(client.ncores().values())


@contextmanager
def _silence_logging() -> Iterator[None]:
    """Disable logging: a lost scheduler raises an error, and its tracebacks say no more."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def _require_versions(address: str, client: Any) -> None:
    """Refuse a scheduler or worker without this version, as both unpickle what they receive."""
    hosts = client.get_versions(packages=["lbt_synth"])
    found = {"the scheduler": hosts["scheduler"]}
    found |= {f"the worker {name}": host for name, host in hosts["workers"].items()}
    for who, host in found.items():
        version = host["packages"].get("lbt_synth")
        if version != lbt_synth.__version__:
            raise ProblemError(
                f"scheduler and workers must have lbt_synth {lbt_synth.__version__}, as here; "
                f"{who} of {address} has {version or 'none'}. Start them from the same environment."
            )
