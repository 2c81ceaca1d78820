import json
import os

import numpy as np
import pytest

from robsmooth._support import files


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "new folder" / "figure.svg"
    files.write_text(path, "old")
    with files.atomic_path(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == path.suffix
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(path.parent) == ["figure.svg"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "result.json"
    files.write_bytes(path, b"old")
    with pytest.raises(error), files.atomic_path(path) as temporary:
        temporary.write_bytes(b"ne")
        raise error
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["result.json"]


def test_a_block_that_writes_nothing_is_an_error_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "result.json"
    files.write_bytes(path, b"old")
    with pytest.raises(FileNotFoundError), files.atomic_path(path):
        pass
    assert path.read_bytes() == b"old"


def test_json_keeps_order_and_takes_numpy_values(tmp_path):
    path = tmp_path / "result.json"
    value = {"b": np.float64(0.1), "a": np.arange(3), "runs": np.int64(5), "λ": True}
    files.write_json(path, value)
    text = path.read_text(encoding="utf-8")
    assert text.endswith("}\n")
    assert list(json.loads(text)) == ["b", "a", "runs", "λ"]
    assert json.loads(text) == {"b": 0.1, "a": [0, 1, 2], "runs": 5, "λ": True}


@pytest.mark.parametrize("value", [float("nan"), np.inf, np.array([1.0, np.nan])])
def test_json_refuses_what_is_not_finite(tmp_path, value):
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(tmp_path / "result.json", {"value": value})
    assert not os.listdir(tmp_path)


def test_json_names_a_type_it_cannot_write(tmp_path):
    with pytest.raises(TypeError, match="type set has no JSON form"):
        files.write_json(tmp_path / "result.json", {1, 2})
