"""Dask clusters on this machine, for the tests of what runs on one."""

import logging
from contextlib import contextmanager

import distributed

from robsmooth._support.cluster import connect
from tests.helpers.waiting import PATIENCE

LOOPBACK = ["--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]  # of Dask's commands


def start_cluster(**options):
    """A cluster of two processes with one thread each, unless the options say otherwise."""
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True} | options
    return distributed.LocalCluster(
        **options,
        host="127.0.0.1",
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # of its other pages, else 8787
        silence_logs=logging.CRITICAL,
    )


@contextmanager
def cluster_of_threads(**options):
    """A cluster that starts quickly: its workers are threads of this process."""
    options = {"n_workers": 1, "threads_per_worker": 2, "protocol": "tcp"} | options
    with (
        start_cluster(processes=False, **options) as cluster,
        connect(cluster.scheduler_address, timeout=PATIENCE) as client,
    ):
        yield cluster, client
