"""Stored files: sealed, bounded before they are believed, and locked."""

import errno
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

from scripts.hunting import files as hunt_files
from sd_friction_env import storage
from sd_friction_env.learning.settings import ALGORITHMS
from sd_friction_env.storage import HYPERPARAMETERS, LockedError, StoredFileError

ROOT = Path(__file__).resolve().parent.parent
CONTENT = {"name": "x", "values": [1.5, 2.0, 1e-300], "nested": {"b": 1, "a": None}}
ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3))}


def flips(data, count, seed=0):
    for place in np.random.default_rng(seed).choice(8 * len(data), count, replace=False).tolist():
        changed = bytearray(data)
        changed[place // 8] ^= 1 << place % 8
        yield bytes(changed)


# Seals ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("indent", [1, 2, None])
def test_a_json_file_is_read_as_it_was_written_and_no_flipped_bit_changes_what_it_says(indent, tmp_path):
    path = tmp_path / "file.json"
    storage.write_json(path, CONTENT, indent=indent)
    assert storage.read_json(path) == CONTENT
    good = path.read_bytes()
    refused = []
    for data in flips(good, min(8 * len(good), 600)):
        path.write_bytes(data)
        try:
            assert storage.read_json(path) == CONTENT
        except StoredFileError as error:
            refused.append(str(error))
    assert len(refused) > 550
    assert all(repr(str(path)) in error for error in refused)


def test_the_layout_of_json_may_change_and_a_value_may_not(tmp_path):
    path = tmp_path / "file.json"
    storage.write_json(path, CONTENT)
    path.write_text(json.dumps(dict(reversed(json.loads(path.read_text()).items()))))
    assert storage.read_json(path) == CONTENT
    path.write_text(path.read_text().replace("1.5", "1.6"))
    with pytest.raises(StoredFileError, match=r"file\.json.*differs from its digest"):
        storage.read_json(path)


@pytest.mark.parametrize("compress", [False, True])
def test_an_archive_is_read_as_it_was_written_by_anybody_and_every_flipped_bit_is_noticed(compress, tmp_path):
    path = tmp_path / "file.npz"
    storage.save_arrays(path, ARRAYS, compress=compress)
    found = storage.load_arrays(path)
    with np.load(path) as archive:
        for name, array in ARRAYS.items():
            assert found[name].dtype == array.dtype
            assert np.array_equal(found[name], array)
            assert np.array_equal(archive[name], array)
    assert zipfile.ZipFile(path).testzip() is None
    good = path.read_bytes()
    for data in [*flips(good, 300), *(good[:length] for length in range(0, len(good), len(good) // 40))]:
        path.write_bytes(data)
        with pytest.raises(StoredFileError, match=r"file\.npz"):
            storage.load_arrays(path)


def test_every_stored_file_of_the_project_has_its_digest():
    archives = [file for folder in ("best", "optimum") for file in (storage.AGENTS / folder).glob("*.npz")]
    tables = list(storage.AGENTS.rglob("*.json"))  # a run's has the digests of its archives
    assert len(archives) + len(tables) > 50
    assert all(map(storage.is_sealed, [*archives, *tables]))
    for path in archives:
        storage.load_arrays(path, "fiu", ("header", "fingerprint"))
    for path in tables:
        storage.read_json(path)


def test_what_is_large_is_not_compressed_so_that_it_can_be_read_again(tmp_path):
    large = np.zeros(storage.LARGEST_INFLATED + 1, np.int8)
    storage.save_arrays(tmp_path / "large.npz", {"labels": large}, compress=True)
    assert np.array_equal(storage.load_arrays(tmp_path / "large.npz")["labels"], large)
    np.savez_compressed(tmp_path / "large.npz", labels=large)
    with pytest.raises(StoredFileError, match=r"33,554,[0-9]+ bytes; at most 33,554,432 are inflated"):
        storage.load_arrays(tmp_path / "large.npz")


def test_python_objects_are_not_written(tmp_path):
    with pytest.raises(TypeError, match="'a' must be numbers or texts, got object"):
        storage.save_arrays(tmp_path / "file.npz", {"a": np.array([None])})
    assert list(tmp_path.iterdir()) == []


# Whole or not at all --------------------------------------------------------------------------------------------------


def test_a_write_that_fails_leaves_the_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "file.json"
    storage.write_json(path, CONTENT)

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        storage.write_json(path, {}, keep=True)
    with pytest.raises(OSError, match="No space left"):
        storage.save_arrays(path, ARRAYS)
    assert storage.read_json(path) == CONTENT
    assert [place.name for place in tmp_path.iterdir()] == ["file.json"]


def test_a_predecessor_is_kept_and_named(tmp_path):
    path = tmp_path / "file.json"
    assert storage.predecessor_hint(path) == ""
    for number in range(3):
        storage.write_json(path, {"number": number}, keep=True)
    assert storage.read_json(path) == {"number": 2}
    assert storage.read_json(storage.predecessor(path)) == {"number": 1}
    assert "file.json.previous" in storage.predecessor_hint(path)


# YAML -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_projects_yaml_is_read_as_pyyaml_reads_it(algorithm):
    path = HYPERPARAMETERS / f"{algorithm}.yml"
    assert storage.read_yaml(path) == yaml.safe_load(path.read_text())


@pytest.mark.parametrize(
    "text",
    ["a: 1", "", "a: &x {b: 1}\nc: {<<: *x, b: 2}", "[1, [2, {3: 4}]]", "a: &x [1, 2]\nb: [*x, *x]", "1.5", "'x'"],
)
def test_plain_yaml_is_read_as_pyyaml_reads_it(text):
    assert storage.parse_yaml(text) == yaml.safe_load(text)


def bomb(level, first):
    """Return a few lines of YAML that stand for a thousand million values."""
    lines = [f"l0: &l0 {first}"]
    lines += [f"l{i}: &l{i} " + level.format(", ".join([f"*l{i - 1}"] * 10)) for i in range(1, 10)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: {b: 1, b: 2}", "'b' is given twice"),
        ("a: &x [*x]", "alias refers to a value that contains it"),
        (bomb("[{}]", "[0]"), "more than 20,000 values"),
        (bomb("{{<<: [{}]}}", "{a: 1}"), "more than 20,000 values"),
        ("[" * 200 + "]" * 200, "200 brackets"),
        ("a: " + "9" * 41, "41 digits"),
        ("a: 2001-99-99", "not YAML: month must be"),
        ("!!python/object:os.system {}", "not YAML"),
        ("x" * 70_000, "70,000 characters"),
    ],
)
def test_yaml_that_could_cost_or_mislead_is_refused(text, said):
    with pytest.raises(StoredFileError, match=said):
        storage.parse_yaml(text)


# All of it ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that can be forked")
def test_damaged_and_hostile_files_are_refused_by_name(monkeypatch):
    monkeypatch.setattr(hunt_files, "SECONDS", 15.0)  # no matter how busy the machine is
    tried, failed = hunt_files.check_files(np.random.default_rng(1))
    assert failed == []
    assert tried > 800


# Locks ----------------------------------------------------------------------------------------------------------------


def test_a_lock_names_its_holder_and_that_of_a_dead_process_blocks_nobody(tmp_path):
    path = tmp_path / "lock"
    program = (
        "import sys\n"
        "from sd_friction_env.storage import locked\n"
        "with locked(sys.argv[1], 'it'):\n"
        "    print('held', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    words = [sys.executable, "-c", program, str(path)]
    with subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        for _ in range(2):  # a refusal changes nothing
            with (
                pytest.raises(LockedError, match=rf"it is in use by process {holder.pid} on .* since 20"),
                storage.locked(path, "it"),
            ):
                pass
        holder.kill()
    assert path.exists()
    with (
        storage.locked(path, "it"),
        pytest.raises(LockedError, match=f"process {os.getpid()} on"),
        storage.locked(path, "it"),
    ):
        pass
    assert not path.exists()
