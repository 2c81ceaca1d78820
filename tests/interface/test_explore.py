"""`make explore`: the sliders in a page of their own, on the loopback, behind a token."""

import ipaddress
import urllib.request
from contextlib import suppress
from urllib.error import HTTPError
from urllib.parse import urlsplit, urlunsplit

import psutil

from tests.helpers.explorers import running_explorer
from tests.helpers.sockets import listening
from tests.helpers.waiting import PATIENCE


def page(url):
    with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
        return answer.read().decode()


def test_the_explorer_is_served_to_who_has_its_token_and_ends_without_a_trace(tmp_path):
    with running_explorer(tmp_path) as (url, server):
        shown = page(url)
        assert "Which smoother, and does robustness pay?" in shown
        assert "application/vnd.jupyter.widget-view+json" in shown
        assert "from robsmooth.explorer" not in shown  # no code
        parts = urlsplit(url)
        assert parts.query.startswith("token=")
        with suppress(HTTPError):
            assert "widget-view" not in page(urlunsplit(parts._replace(query="")))
        family = [server, *server.children(recursive=True)]
        ports = listening(server)
        assert parts.port in {address.port for address in ports}
        assert all(ipaddress.ip_address(address.ip).is_loopback for address in ports)
    assert server.returncode == 0
    assert not psutil.wait_procs(family, timeout=PATIENCE)[1]
