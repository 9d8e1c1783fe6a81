"""A run on somebody's Dask cluster: the way to it, what its workers must meet, and paths that hold there."""

import dataclasses
import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

from pipeline.errors import CityError
from tiler.config.config import Config
from tiler.engine.task_limits import Limits
from tiler.executors.executor import Executor
from tiler.objects.places import absolute, is_url
from tiler.pointclouds.clouds import find_clouds
from tiler.scheduler.check import check_cluster
from tiler.scheduler.executor import Dask
from tiler.scheduler.terms import Terms, offer_terms, own_terms
from tiler.scheduler.transport import NO_FILES, TlsFiles, check_answer, make_security

TCP_TIMEOUT = "distributed.comm.timeouts.tcp"
PATIENCE = 120.0  # s that a link may be cut; Dask by itself gives it up after 30 s


@contextmanager
def reach_cluster(config: Config) -> Iterator[Executor | None]:
    """Connect to the scheduler of a run, and hold its workers against this process; None where there is none.

    Parameters
    ----------
    config : Config
        Parameters of the run, its folder held.

    Raises
    ------
    CityError
        As `connect` and `tiler.scheduler.terms.offer_terms`; nothing is left in the folder.
    """
    if not config.scheduler:
        yield None
        return
    given = [str(path) for path in (*find_clouds(config.pointcloud), config.footprints) if str(path)]
    files = [Path(path) for path in given if not is_url(path)]
    # Who reaches a bucket reaches the same one, and is told in its first task if it does not.
    with (
        nullcontext(own_terms())
        if is_url(config.out)
        else offer_terms(Path(config.out).absolute(), files) as terms,
        connect(
            config.scheduler,
            Limits(config.time_limit),
            tls=TlsFiles(config.tls_ca, config.tls_cert, config.tls_key),
            terms=terms,
        ) as executor,
    ):
        yield executor


def spell_out(config: Config) -> Config:
    """Make the paths of a run absolute where it is on a cluster: a worker has another current folder."""
    if not config.on_cluster:
        return config
    return dataclasses.replace(
        config,
        pointcloud=tuple(map(absolute, config.pointcloud)),
        footprints=absolute(config.footprints) if config.footprints else "",
        out=absolute(config.out),
    )


@contextmanager
def connect(
    address: str,
    limits: Limits | None = None,
    *,
    tls: TlsFiles = NO_FILES,
    terms: Terms | None = None,
) -> Iterator[Executor]:
    """Run tasks on a Dask cluster whose workers see the same store and files; it is left running.

    Parameters
    ----------
    address : str
        Address of its scheduler, ``"tcp://10.0.0.1:8786"`` or ``"tls://10.0.0.1:8786"``.
    limits : Limits, optional
        The time limit holds if workers have one thread each; the memory limit is the cluster's own.
    tls : TlsFiles
        Files of TLS; those of Dask's configuration by default.
    terms : Terms, optional
        What its workers must meet; their versions alone by default.

    Raises
    ------
    CityError
        If nothing answers there, or it has no workers.
    ConfigError
        If it cannot be reached that way, or a worker does not meet the terms: see `tiler.scheduler.transport` and
        `tiler.scheduler.check`.

    Notes
    -----
    A worker that dies is not replaced: the others take its tasks. A lost scheduler ends the run with a
    `ClusterError`, and so does a cluster that has had no worker for `NO_WORKERS` seconds. A link to the scheduler
    that is cut is lost after `PATIENCE`, or what Dask's configuration has for it if that is more.
    """
    from dask import config
    from dask.utils import parse_timedelta
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    security = make_security(address, tls)
    check_answer(address, security)
    terms = terms or own_terms()
    patience = max(parse_timedelta(config.get(TCP_TIMEOUT)), PATIENCE)
    with ExitStack() as stack:
        stack.enter_context(config.set({TCP_TIMEOUT: f"{patience:g}s"}))
        try:
            client = Client(address, security=security)
        except (OSError, RuntimeError) as error:
            raise CityError(
                f"{address}: no Dask scheduler answers ({error}); start one, or check the address"
            ) from error
        # A lost scheduler is told once, by us.
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))
        stack.enter_context(client)
        threads = list(client.nthreads().values())
        if not threads:
            raise CityError(f"{address}: the scheduler has no workers; start some and run again")
        check_cluster(client, address, terms)
        seconds = limits.seconds if limits is not None and max(threads) == 1 else 0.0
        yield Dask(client, sum(threads), Limits(seconds), terms=terms)
