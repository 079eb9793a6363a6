"""Connection to a Dask cluster, the only module that imports dask.distributed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import lbt_synth
from lbt_synth.errors import MissingExtraError, ProblemError

_TIMEOUT_S = 10


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
        # a client hangs where nothing answers, and complains again when it is collected
        with _silence_logging():
            asyncio.run(asyncio.wait_for(_greet(address, security), 3 * _TIMEOUT_S))
        client: Any = Client(address, timeout=_TIMEOUT_S, set_as_default=False, security=security)
    except Exception as error:  # foreign answers raise whatever they like
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


async def _greet(address: str, security: Any) -> None:
    """Ask who answers at an address; OSError if it is no scheduler."""
    from distributed.comm import connect, get_address_host_port
    from distributed.core import send_recv

    full = address if "://" in address else f"tcp://{address}"
    get_address_host_port(full, strict=True)
    comm = await connect(full, timeout=_TIMEOUT_S, **security.get_connection_args("client"))
    try:
        found = await asyncio.wait_for(send_recv(comm, op="identity"), _TIMEOUT_S)
    finally:
        comm.abort()
    if not isinstance(found, dict) or found.get("type") != "Scheduler":
        raise OSError("what answers is no scheduler")


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
