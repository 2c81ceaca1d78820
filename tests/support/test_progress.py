"""Progress bars: where they are shown, where they are not, and what they say."""

import os
import queue
import subprocess
import sys
import termios
from contextlib import suppress

import pytest

from robsmooth import augment, best_smoother, homodyne, lag_sweep
from robsmooth._support.progress import progress_bar
from tests.helpers.waiting import PATIENCE

SYSTEM = homodyne.PAPER.uncertain_system()
SWITCHES = ("CI", "TQDM_DISABLE")
CODE = "from robsmooth._support.progress import progress_bar\nfor _ in progress_bar(range(3)): pass"


def without_switches():
    """The environment of somebody who watches."""
    return {name: value for name, value in os.environ.items() if name not in SWITCHES}


def shown_by_a_bar(capture):
    """What a bar of three steps shows."""
    assert list(progress_bar(range(3), unit="step")) == [0, 1, 2]
    captured = capture.readouterr()
    assert captured.out == ""
    return captured.err


def test_a_bar_is_shown_in_a_terminal():
    ours, theirs = os.openpty()
    termios.tcsetwinsize(theirs, (24, 80))
    subprocess.run([sys.executable, "-c", CODE], stderr=theirs, env=without_switches(), check=True)
    os.close(theirs)
    shown = b""
    with suppress(OSError):  # at the end, for nobody has the other side open any more
        while part := os.read(ours, 4096):
            shown += part
    os.close(ours)
    assert b"3/3" in shown


def test_no_bar_where_stderr_is_no_terminal(capfd, monkeypatch):
    for name in SWITCHES:
        monkeypatch.delenv(name, raising=False)
    assert shown_by_a_bar(capfd) == ""


@pytest.mark.parametrize("name", SWITCHES)
@pytest.mark.parametrize("value", ["true", "1"])
def test_no_bar_where_the_environment_says_so(terminal, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    assert shown_by_a_bar(terminal) == ""


@pytest.mark.parametrize("value", ["", "0", "False"])
def test_a_bar_where_the_environment_says_no(terminal, monkeypatch, value):
    monkeypatch.setenv("CI", value)
    assert "3/3" in shown_by_a_bar(terminal)


def test_a_bar_counts_what_it_is_told(terminal):
    with progress_bar(total=40, initial=30, unit="path") as bar:
        bar.update(10)
    assert "40/40" in terminal.readouterr().err


def test_no_bar_where_none_is_asked_for(terminal):
    assert list(progress_bar(range(3), shown=False)) == [0, 1, 2]
    assert terminal.readouterr().err == ""


def test_a_lag_sweep_shows_its_designs(terminal):
    silent = lag_sweep(SYSTEM, [1e-6, 2e-6], [1, 2])
    assert terminal.readouterr().err == ""
    shown = lag_sweep(SYSTEM, [1e-6, 2e-6], [1, 2], progress=True)
    assert "4/4" in terminal.readouterr().err
    assert (shown.nominal == silent.nominal).all() and (shown.worst == silent.worst).all()
    with pytest.raises(TypeError, match="progress must be True or False"):
        lag_sweep(SYSTEM, [1e-6], [1], progress="yes")


def test_a_choice_shows_its_candidates(terminal):
    best_smoother(augment(SYSTEM, 0.0, 0), output="filtered", progress=True)
    assert "5/5" in terminal.readouterr().err


# --- in a notebook --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kernel():
    jupyter = pytest.importorskip("jupyter_client.manager", reason="the library needs no Jupyter")
    manager, client = jupyter.start_new_kernel(
        startup_timeout=PATIENCE, kernel_name="python3", env=without_switches()
    )
    yield client
    client.stop_channels()
    manager.shutdown_kernel(now=True)


def outputs(client, code):
    """What a cell shows: texts of its streams, and mime types with their texts."""
    streams, shown = [], []

    def collect(message):
        content = message["content"]
        if message["msg_type"] == "stream":
            streams.append(content["text"])
        elif message["msg_type"] in ("display_data", "execute_result"):
            shown.append(content["data"])
        assert message["msg_type"] != "error", content

    try:
        reply = client.execute_interactive(code, output_hook=collect, timeout=PATIENCE)
    except queue.Empty:
        pytest.fail("the kernel did not answer")
    assert reply["content"]["status"] == "ok"
    return "".join(streams), shown


def test_a_notebook_shows_a_bar_of_widgets_and_no_warning(kernel):
    streams, (shown,) = outputs(kernel, CODE)
    assert streams == ""
    assert "application/vnd.jupyter.widget-view+json" in shown
    assert "0/3" in shown["text/plain"]


def test_a_notebook_is_quiet_where_the_environment_says_so(kernel):
    quiet = f"import os; os.environ['TQDM_DISABLE'] = '1'\n{CODE}\ndel os.environ['TQDM_DISABLE']"
    assert outputs(kernel, quiet) == ("", [])


def test_a_notebook_without_widgets_shows_a_bar_of_text(kernel):
    missing = "import sys; sys.modules['ipywidgets'] = None\n"
    streams, shown = outputs(kernel, missing + CODE)
    assert "3/3" in streams and "Warning" not in streams
    assert shown == []
