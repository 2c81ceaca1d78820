"""`make lab`: JupyterLab with its default security, beside another one, ended without a trace."""

import ast
import ipaddress
import json
import sys

import psutil
import pytest
from jupyter_client import BlockingKernelClient

from tests.helpers.labs import ROOT, running_lab
from tests.helpers.sockets import listening
from tests.helpers.waiting import PATIENCE


@pytest.fixture(scope="module")
def labs(tmp_path_factory):
    """Two at once, at home in the same folders, as those of one user are."""
    home = tmp_path_factory.mktemp("lab")
    with running_lab(home) as first, running_lab(home) as second:
        yield first, second


def test_a_second_lab_takes_a_port_and_a_token_of_its_own(labs):
    first, second = labs
    assert first.port != second.port
    assert first.token != second.token
    assert first.request("GET", "/api/contents", second.token)[0] == 403


def test_labs_listen_on_the_loopback_only(labs):
    for lab in labs:
        assert lab.port in {address.port for address in listening(lab.make)}
        assert all(ipaddress.ip_address(address.ip).is_loopback for address in listening(lab.make))


def test_nothing_is_shown_without_the_token(labs):
    for lab in labs:
        assert len(lab.token) >= 32
        assert lab.request("GET", "/lab")[0] == 302  # to the page that asks for it
        for path in ("/api/contents", "/api/kernels", "/files/01_uncertainty_modelling.ipynb"):
            assert lab.request("GET", path)[0] in {302, 403}, path
            assert lab.request("GET", path, "a wrong one")[0] in {302, 403}, path
        assert lab.request("POST", "/api/kernels")[0] == 403
        assert lab.request("GET", "/lab", lab.token)[0] == 200


def test_a_lab_shows_the_notebooks(labs):
    there = {path.name for path in ROOT.glob("notebooks/*.ipynb")}
    for lab in labs:
        status, content = lab.request("GET", "/api/contents", lab.token)
        assert status == 200
        assert {entry["name"] for entry in json.loads(content)["content"]} >= there


def test_kernels_have_the_environment_of_the_project(labs):
    for lab in labs:
        client = BlockingKernelClient()
        client.load_connection_file(lab.start_kernel("01_uncertainty_modelling.ipynb"))
        client.start_channels()
        try:
            client.wait_for_ready(timeout=PATIENCE)
            where = client.execute(
                "import os, sys, robsmooth",
                user_expressions={"it": "sys.prefix, os.getcwd(), robsmooth.__file__"},
                reply=True,
                timeout=PATIENCE,
            )["content"]["user_expressions"]["it"]["data"]["text/plain"]
        finally:
            client.stop_channels()
        places = (sys.prefix, str(ROOT / "notebooks"), str(ROOT / "robsmooth/__init__.py"))
        assert ast.literal_eval(where) == places


def test_a_lab_ends_with_all_that_it_has_started(tmp_path):
    with running_lab(tmp_path) as lab:
        lab.start_kernel("01_uncertainty_modelling.ipynb")
        family = [lab.make, *lab.make.children(recursive=True)]
        assert len(family) >= 3  # make, JupyterLab, the kernel
    assert lab.make.returncode == 0
    assert not psutil.wait_procs(family, timeout=PATIENCE)[1]
