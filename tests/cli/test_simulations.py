"""Commands that make data with known truth."""

from __future__ import annotations

from small_surveys import run

from changedetect.cli import main


def test_simulate_without_a_kind_makes_surveys(tmp_path, capsys):
    document = run(capsys, "simulate", tmp_path / "demo", "--dry-run")
    assert document["command"] == "simulate surveys"
    assert document == run(capsys, "simulate", "surveys", tmp_path / "demo", "--dry-run")
    assert run(capsys, "simulate", "--dry-run", tmp_path / "demo")["n_points"] == document["n_points"]
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_of_a_flight_lists_its_files_and_writes_nothing(tmp_path, capsys):
    arguments = ["simulate", "flight", tmp_path / "f", "--photos", "5", "--size", "320", "240", "--epochs", "3"]
    document = run(capsys, *arguments, "--dry-run")
    assert document["flights"] == ["epoch1", "epoch2", "epoch3"]
    assert document["n_photos"] == 30
    assert {"epoch3/imu.csv", "truth/change_1to3.tif", "camera.yaml"} <= {*document["files"]}
    assert list(tmp_path.iterdir()) == []


def test_a_flight_is_written_as_listed_and_not_replaced_unasked(tmp_path, capsys):
    arguments = ["simulate", "flight", tmp_path / "f", "--photos", "6", "--size", "240", "200", "--epochs", "1"]
    document = run(capsys, *arguments)
    found = {path.relative_to(tmp_path / "f").as_posix() for path in (tmp_path / "f").rglob("*") if path.is_file()}
    photos = {name for name in found if name.endswith(".jpg")}
    assert found - photos == {*document["files"]}
    assert len(photos) == document["n_photos"] == 12
    assert main([*map(str, arguments)]) == 73
    assert "holds flights already" in capsys.readouterr().err


def test_flights_that_cannot_be_made_are_configuration_errors(tmp_path, capsys):
    assert main(["simulate", "flight", str(tmp_path / "f"), "--size", "100", "100"]) == 78
    assert "200 x 200 are needed" in capsys.readouterr().err
