"""Files are whole or absent, whatever happens while they are written."""

from __future__ import annotations

import json
import os
import resource
import signal
import stat
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from changedetect.errors import MissingInputError, ModelStateError, OutputError
from changedetect.storage import (
    atomic_directory,
    atomic_path,
    clear_leftovers,
    read_dataset,
    read_json,
    sha256_of_file,
    write_dataset,
    write_json,
)


@pytest.fixture
def small_storage():
    """Storage on which no file can grow beyond 100 kB, as on a full disk."""
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, handler)


def test_file_appears_only_when_the_block_ends(tmp_path):
    target = tmp_path / "deep" / "er" / "map.tif"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"whole")
        assert not target.exists()
        assert temporary.parent == target.parent
        assert temporary.name.startswith(f"map.tif.tmp-{os.getpid()}-")
        assert temporary.suffix == ".tif"
    assert target.read_bytes() == b"whole"
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyboardInterrupt()])
def test_old_file_survives_any_error_in_the_block(tmp_path, error):
    target = tmp_path / "state.nc"
    target.write_text("old")

    def write_half():
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(type(error)):
        write_half()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_new_file_has_the_permissions_the_user_asked_for(tmp_path):
    mask = os.umask(0o027)
    try:
        write_json(tmp_path / "a.json", {})
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o640


def test_two_writers_of_one_target_do_not_share_a_temporary(tmp_path):
    with atomic_path(tmp_path / "a") as first, atomic_path(tmp_path / "a") as second:
        assert first != second
        first.write_text("1")
        second.write_text("2")
    assert (tmp_path / "a").read_text() == "1"  # the outer block ends last


def test_folder_that_is_a_file_is_refused_with_its_name(tmp_path):
    (tmp_path / "products").write_text("a file")
    with pytest.raises(OutputError, match=r"Cannot write into .*products: .*writable folder"):
        write_json(tmp_path / "products" / "summary.json", {})


def test_folder_without_permission_is_refused():
    with pytest.raises(OutputError, match="Cannot write into /proc/1/changedetect"):
        write_json(Path("/proc/1/changedetect/a.json"), {})


def test_target_that_is_a_folder_is_refused(tmp_path):
    (tmp_path / "a.json" / "inside").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"Cannot write .*a\.json"):
        write_json(tmp_path / "a.json", {})
    assert (tmp_path / "a.json" / "inside").is_dir()


def test_block_that_writes_nothing_is_an_error(tmp_path):
    with pytest.raises(OutputError, match="Nothing was written"), atomic_path(tmp_path / "a"):
        pass


@pytest.mark.usefixtures("small_storage")
def test_full_disk_leaves_the_old_file(tmp_path):
    (tmp_path / "a.json").write_text('"old"')
    with pytest.raises(OutputError, match=r"Cannot write .*a\.json: File too large"):
        write_json(tmp_path / "a.json", "x" * 200_000)
    assert read_json(tmp_path / "a.json") == "old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.usefixtures("small_storage")
def test_full_disk_leaves_the_old_dataset(tmp_path):
    write_dataset(tmp_path / "a.nc", xr.Dataset({"v": ("n", np.arange(3.0))}))
    noise = np.random.default_rng(0).normal(size=100_000)
    with pytest.raises(OutputError, match=r"Cannot write .*a\.nc"):
        write_dataset(tmp_path / "a.nc", xr.Dataset({"v": ("n", noise)}))
    np.testing.assert_array_equal(read_dataset(tmp_path / "a.nc").v, np.arange(3.0))
    assert len(list(tmp_path.iterdir())) == 1


def test_folder_is_replaced_as_a_whole(tmp_path):
    target = tmp_path / "product"
    for names in (["a", "b"], ["c"]):
        with atomic_directory(target) as folder:
            (folder / "sub").mkdir()
            for name in names:
                (folder / "sub" / name).write_text(name)
    assert [p.name for p in (target / "sub").iterdir()] == ["c"]
    assert list(tmp_path.iterdir()) == [target]


def test_old_folder_survives_an_error_in_the_block(tmp_path):
    target = tmp_path / "product"
    target.mkdir()
    (target / "old").touch()

    def write_half():
        with atomic_directory(target) as folder:
            (folder / "new").touch()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_half()
    assert [p.name for p in target.iterdir()] == ["old"]
    assert list(tmp_path.iterdir()) == [target]


def test_folder_behind_a_link_is_replaced_and_the_link_stays(tmp_path):
    (tmp_path / "disk" / "product").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "product")
    with atomic_directory(tmp_path / "link") as folder:
        (folder / "new").touch()
    assert (tmp_path / "link").is_symlink()
    assert [p.name for p in (tmp_path / "disk" / "product").iterdir()] == ["new"]
    assert [p.name for p in (tmp_path / "disk").iterdir()] == ["product"]


def test_current_folder_can_be_published(tmp_path, monkeypatch):
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    with atomic_directory(Path()) as folder:
        (folder / "new").touch()
    assert (tmp_path / "out" / "new").exists()


def test_folder_does_not_replace_a_file(tmp_path):
    (tmp_path / "product").write_text("keep")
    with pytest.raises(OutputError, match="a file of that name exists"), atomic_directory(tmp_path / "product"):
        pass
    assert (tmp_path / "product").read_text() == "keep"


def test_killed_process_leaves_the_old_file_and_leftovers_that_can_be_cleared(tmp_path):
    (tmp_path / "a.json").write_text("1")
    code = (
        "import pathlib, sys, time\n"
        "from changedetect.storage import atomic_directory, atomic_path\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "with atomic_path(folder / 'a.json') as t, atomic_directory(folder / 'product') as d:\n"
        "    t.write_text('half'); (d / 'half').touch(); (folder / 'ready').touch(); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=os.environ | {"PYTHONPATH": "."}) as process:
        deadline = time.monotonic() + 20
        while not (tmp_path / "ready").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        process.kill()
    assert (tmp_path / "a.json").read_text() == "1"
    assert not (tmp_path / "product").exists()
    assert len(list(tmp_path.iterdir())) == 4
    assert len(clear_leftovers(tmp_path)) == 2
    assert {p.name for p in tmp_path.iterdir()} == {"a.json", "ready"}


def test_folder_caught_between_its_two_renames_is_put_back(tmp_path):
    old = tmp_path / "products" / "a_b.old-123-0123abcd"
    old.mkdir(parents=True)
    (old / "dod.tif").touch()
    (tmp_path / "products" / "keep.tmp").touch()  # not one of ours
    assert clear_leftovers(tmp_path) == [old]
    assert (tmp_path / "products" / "a_b" / "dod.tif").exists()
    assert (tmp_path / "products" / "keep.tmp").exists()


def test_old_folder_beside_its_successor_is_removed(tmp_path):
    (tmp_path / "a_b").mkdir()
    (tmp_path / "a_b.old-123-0123abcd" / "x").mkdir(parents=True)
    assert clear_leftovers(tmp_path) == [tmp_path / "a_b.old-123-0123abcd"]
    assert [p.name for p in tmp_path.iterdir()] == ["a_b"]


def test_json_round_trip_of_numbers_paths_and_dates(tmp_path):
    document = {
        "volume": np.float64(1.25),
        "n": np.int64(3),
        "flag": np.bool_(True),
        "array": np.array([[1.0, np.nan], [np.inf, 2.0]]),
        "path": Path("a/b"),
        "time": datetime(2024, 5, 1, tzinfo=UTC),
        "name": "Höhe",
        5: (None, -np.inf),
    }
    write_json(tmp_path / "a.json", document)
    assert read_json(tmp_path / "a.json") == {
        "volume": 1.25,
        "n": 3,
        "flag": True,
        "array": [[1.0, None], [None, 2.0]],
        "path": "a/b",
        "time": "2024-05-01T00:00:00+00:00",
        "name": "Höhe",
        "5": [None, None],
    }
    assert "Höhe" in (tmp_path / "a.json").read_text(encoding="utf-8")
    json.loads((tmp_path / "a.json").read_bytes(), parse_constant=pytest.fail)


def test_json_of_an_unknown_object_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_json(tmp_path / "a.json", object())
    assert not list(tmp_path.iterdir())


def test_damaged_json_names_file_line_and_column(tmp_path):
    (tmp_path / "a.json").write_text('{"a": 1,\n "b": }')
    with pytest.raises(ModelStateError, match=r"a\.json is damaged: .* line 2, column 7"):
        read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_bytes(b'"\xff"')
    with pytest.raises(ModelStateError, match=r"byte 1 is not UTF-8"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("read", [read_json, read_dataset, sha256_of_file])
def test_missing_file_is_named(tmp_path, read):
    with pytest.raises(MissingInputError, match=r"No such file: .*nothing\.nc"):
        read(tmp_path / "nothing.nc")


def test_sha256_of_a_known_message(tmp_path):
    (tmp_path / "abc").write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    assert sha256_of_file(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_dataset_comes_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(1)
    values = rng.normal(size=(50, 3)) * 10.0 ** rng.integers(-300, 300, size=(50, 3))
    values[0] = [np.nan, np.inf, -0.0]
    dataset = xr.Dataset(
        {
            "moments": (("field", "term"), values),
            "birth": ("field", np.arange(50, dtype=np.int64), {"units": "days since 1970-01-01"}),
            "memory": ((), 30.0, {"units": "days"}),
            "empty": ("nothing", np.empty(0)),
        },
        attrs={"format_version": 1, "lineage": "a b"},
    )
    write_dataset(tmp_path / "a.nc", dataset)
    again = read_dataset(tmp_path / "a.nc")
    assert again.moments.values.tobytes() == values.tobytes()
    assert again.birth.dtype == np.int64
    assert again.memory.dtype == np.float64
    assert again.attrs == dataset.attrs
    (tmp_path / "a.nc").unlink()  # closed: the values do not depend on the file
    assert again.identical(dataset)


def test_same_dataset_gives_the_same_bytes(tmp_path):
    dataset = xr.Dataset({"v": ("n", np.arange(1000.0))})
    write_dataset(tmp_path / "a.nc", dataset)
    first = (tmp_path / "a.nc").read_bytes()
    write_dataset(tmp_path / "a.nc", dataset)
    assert (tmp_path / "a.nc").read_bytes() == first


def test_dataset_is_compressed(tmp_path):
    write_dataset(tmp_path / "a.nc", xr.Dataset({"v": ("n", np.zeros(1_000_000))}))
    assert (tmp_path / "a.nc").stat().st_size < 100_000


@pytest.mark.parametrize("damage", ["truncated", "text", "empty"])
def test_damaged_dataset_is_refused(tmp_path, damage):
    path = tmp_path / "a.nc"
    write_dataset(path, xr.Dataset({"v": ("n", np.random.default_rng(0).normal(size=10_000))}))
    whole = path.read_bytes()
    path.write_bytes({"truncated": whole[: len(whole) // 2], "text": b"not netcdf", "empty": b""}[damage])
    with pytest.raises(ModelStateError, match=r"a\.nc cannot be read as NetCDF"):
        read_dataset(path)


def test_times_are_decoded_on_request(tmp_path):
    dataset = xr.Dataset({"t": ("n", np.array([0.0]), {"units": "days since 1970-01-02"})})
    write_dataset(tmp_path / "a.nc", dataset)
    assert read_dataset(tmp_path / "a.nc").t.values == [0.0]
    assert read_dataset(tmp_path / "a.nc", decode_times=True).t.values == [np.datetime64("1970-01-02")]
