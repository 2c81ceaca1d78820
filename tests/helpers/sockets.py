"""What a process and all that it has started listen on."""

from contextlib import suppress

import psutil


def listening(process):
    """Return addresses, each with an ip and a port."""
    found = []
    for each in (process, *process.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):  # one that was asked something, and ended
            found += [
                socket.laddr
                for socket in each.net_connections("inet")
                if socket.status == psutil.CONN_LISTEN
            ]
    return found
