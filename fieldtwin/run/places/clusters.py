"""The values of `--on`: where a campaign runs, and how its cluster is found.

`slurm` and `kubernetes` start a Dask cluster as the user has configured it for dask-jobqueue or dask-kubernetes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from fieldtwin.gateway.core.errors import Unreachable, UsageError
from fieldtwin.installation import install_hint
from fieldtwin.run.places.local import LocalPlace
from fieldtwin.run.places.names import DASK, KUBERNETES, LOCAL, SLURM
from fieldtwin.run.places.place import Place

if TYPE_CHECKING:
    from distributed import Client

FORMS = "local, dask://HOST:PORT, slurm or kubernetes"
DASK_PORT = 8786
CONNECT_S = 10.0
"""The time to connect to a scheduler, in seconds."""
WORKERS_WAIT_S = 600.0
"""How long a campaign waits for a worker of an existing scheduler, in seconds."""
QUEUE_WAIT_S = 86_400.0
"""How long a campaign waits until SLURM or Kubernetes starts a worker, in seconds."""
_STARTED = {
    SLURM: ("dask_jobqueue", "SLURMCluster", "dask-jobqueue", "~/.config/dask/jobqueue.yaml"),
    KUBERNETES: ("dask_kubernetes.operator", "KubeCluster", "dask-kubernetes", "~/.config/dask/kubernetes.yaml"),
}
"""For each cluster that is started here: the module and the class, the package and its configuration file."""


def place_named(text: str, jobs: int | None) -> Place:
    """Return the place that `--on` names. `jobs`: the number of units at a time; None if the user named none.

    Raises `UsageError`; a cluster is connected to when the campaign runs.
    """
    if text == LOCAL:
        return LocalPlace(jobs or 1)
    if text in _STARTED:
        _check_package(text)
        return _dask(partial(_started, text, jobs or 1), text, QUEUE_WAIT_S)
    if not text.startswith(DASK):
        raise UsageError("--on", expected=FORMS, got=text)
    if jobs is not None:
        raise UsageError(
            "--jobs has no effect with --on dask://: the cluster runs one unit for each thread of its workers",
            hint="dask worker --nworkers N --nthreads 1 sets it",
        )
    return _dask(partial(_existing, _address(text)), text, WORKERS_WAIT_S)


def _check_package(kind: str) -> None:
    """Raise `UsageError` if the package that starts this kind of cluster is not installed."""
    module, _, package, file = _STARTED[kind]
    if find_spec(module.partition(".")[0]) is None:
        raise UsageError(
            f"--on {kind} needs {package}", expected=f"{package}, configured in {file}", hint=f"pip install {package}"
        )


def _dask(connect: Callable[[], AbstractContextManager[Client]], name: str, wait_s: float) -> Place:
    if find_spec("distributed") is None:
        raise UsageError(f"--on {name} needs an extra", hint=install_hint("cluster"))
    from fieldtwin.run.places.dask_place import DaskPlace

    return DaskPlace(connect, name, wait_s)


def _address(text: str) -> str:
    try:
        url = urlsplit(text)
        host, port = url.hostname, url.port or DASK_PORT
    except ValueError:
        host, port = None, 0
    if not host or url.path or url.query or url.username:
        raise UsageError("--on", expected="dask://HOST:PORT, such as dask://10.0.0.5:8786", got=text)
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


@contextmanager
def _existing(address: str) -> Iterator[Client]:
    client = _client(address, address.replace("tcp://", DASK))
    try:
        yield client
    finally:
        client.close(timeout=CONNECT_S)


def _client(address: Any, name: str) -> Client:
    from distributed import Client

    # they would log tracebacks when the scheduler is lost, which the campaign reports itself
    for logger in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as e:
        raise Unreachable(
            f"no Dask scheduler answers: {e}", where=name, hint="start one with: dask scheduler --port 8786"
        ) from e


@contextmanager
def _started(kind: str, jobs: int) -> Iterator[Client]:
    """Start a cluster with `jobs` workers, and end it after the block."""
    module, class_name, package, file = _STARTED[kind]
    cluster_class = getattr(import_module(module), class_name)
    try:
        cluster = cluster_class()
    except Exception as e:  # each of these packages reports a missing or wrong configuration in its own way
        raise UsageError(
            f"{package} cannot start a cluster: {' '.join(str(e).split())}",
            expected=f"a complete configuration in {file}",
            hint="docs/how-to/many-computers.md has an example",
        ) from e
    with cluster:
        cluster.scale(jobs)
        client = _client(cluster, kind)
        try:
            yield client
        finally:
            client.close(timeout=CONNECT_S)
