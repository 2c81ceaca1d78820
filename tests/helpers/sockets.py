"""Ports: a free one, and those on which a process and all that it has started listen."""

import socket
from contextlib import suppress

import psutil


def free_port():
    """Return a port of the loopback that nothing listens on now."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def listening(process):
    """Return addresses, each with an ip and a port."""
    found = []
    for each in (process, *process.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):  # one that was asked something, and ended
            found += [
                connection.laddr
                for connection in each.net_connections("inet")
                if connection.status == psutil.CONN_LISTEN
            ]
    return found
