"""What holds for every command: help, documents, logs, exit codes, and how fast it answers."""

from __future__ import annotations

import inspect
import json
import logging
import subprocess
import sys
from pathlib import Path

import pytest
from small_surveys import CRS, make_programme, run

from changedetect.cli import main
from changedetect.cli.app import app
from changedetect.cli.reference import _commands as iter_commands
from changedetect.cli.reference import main as reference_main
from changedetect.cli.reference import reference
from changedetect.cli.session import COMMON_OPTIONS
from changedetect.pipeline.update import update

REPOSITORY = Path(__file__).resolve().parents[2]
COMMANDS = dict(iter_commands(app, ""))
FIRST, SECOND = "2024-01-01", "2024-07-01"


def test_the_commands_are_those_of_the_contract():
    assert list(COMMANDS) == [
        "init",
        "add",
        "withdraw",
        "update",
        "status",
        "verify",
        "predict",
        "surface",
        "diff",
        "volume",
        "series",
        "compare",
        "reconstruct",
        "config show",
        "simulate surveys",
        "simulate flight",
    ]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_an_example_and_the_common_options(name, capsys):
    assert main([*name.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert "For example" in text
    assert f"changedetect {name}" in text
    assert set(COMMON_OPTIONS) <= set(inspect.signature(COMMANDS[name]).parameters)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_stands_in_the_reference(name):
    assert f"\n## {name}\n" in (REPOSITORY / "docs/reference/cli.md").read_text()


def test_the_reference_is_current(capsys):
    path = REPOSITORY / "docs/reference/cli.md"
    assert path.read_text() == reference()
    assert reference_main(["--check", str(path)]) == 0


def test_an_outdated_reference_is_found_and_renewed(tmp_path, capsys):
    path = tmp_path / "docs" / "cli.md"
    assert reference_main(["--check", str(path)]) == 1
    assert "is not current. Run: make docs" in capsys.readouterr().err
    assert reference_main([str(path)]) == 0
    assert reference_main(["--check", str(path)]) == 0
    assert reference_main([]) == 2


@pytest.mark.parametrize("arguments", [["--help"], ["update", "--help"], ["--version"], ["init"]])
def test_help_loads_neither_compiled_code_nor_gdal(arguments):
    code = (
        "import sys\nfrom changedetect.cli import main\n"
        f"main({arguments!r})\n"
        "heavy = {'numba', 'rasterio', 'scipy', 'xarray', 'laspy', 'netCDF4', 'pyproj', 'numpy'}\n"
        "print('LOADED', sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "LOADED []"


def test_importing_the_package_loads_nothing_heavy():
    code = "import sys, changedetect\nprint(sorted({'numba', 'rasterio', 'numpy'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("changedetect 0.")


@pytest.mark.parametrize(
    "arguments", [["update"], ["no-such-command"], ["status", "x", "--no-such-option"], ["add", "x"]]
)
def test_wrong_usage_is_2_with_a_hint_and_as_json_when_asked(arguments, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Error: " in captured.err
    error = run(capsys, *arguments, expect=2)["error"]
    assert error["exit_code"] == 2


def test_errors_go_to_stderr_and_name_the_fix(tmp_path, capsys):
    assert main(["status", str(tmp_path)]) == 66
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("Error: ")
    assert "changedetect init" in captured.err


def test_an_interrupt_is_130(tmp_path, capsys, monkeypatch):
    from changedetect.catalogue import Programme

    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(Programme, "open", interrupted)
    assert run(capsys, "status", tmp_path, expect=130)["error"]["class"] == "KeyboardInterrupt"


def test_a_bug_is_1_and_an_input_output_error_74(tmp_path, capsys, monkeypatch):
    from changedetect.catalogue import Programme

    for error, code in ((ZeroDivisionError("by design"), 1), (OSError(5, "Input/output error"), 74)):

        def fails(*arguments, error=error, **options):
            raise error

        monkeypatch.setattr(Programme, "open", fails)
        document = run(capsys, "status", tmp_path, expect=code)
        assert document["error"]["class"] == type(error).__name__


def test_quiet_prints_nothing_but_warnings(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {"offset": -0.41}})
    assert main(["update", str(programme.directory), "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert all("warning" in line for line in lines)
    assert "The epoch lies 0.41 m below the reference everywhere" in lines[0]
    assert main(["update", str(programme.directory), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_logs_carry_run_programme_and_epoch_as_json(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    assert main(["update", str(programme.directory), "--log-format", "json"]) == 0
    records = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    reading = next(record for record in records if "points used" in record["message"])
    assert (reading["programme"], reading["epoch"], reading["level"]) == ("site", FIRST, "INFO")
    assert reading["run"] == next((programme.directory / "runs").glob("*.json")).stem


def test_logs_carry_priorities_and_no_time_for_the_journal(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    programme = make_programme(tmp_path / "site", {FIRST: {}, SECOND: {"offset": 1.0}})
    assert main(["update", str(programme.directory)]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert all(line[:3] in ("<6>", "<4>") for line in lines)
    # the step that was taken out, and why nothing but heights could be aligned
    assert sum(line.startswith("<4>") for line in lines) == 2


def test_logging_is_left_as_it_was(tmp_path):
    programme = make_programme(tmp_path / "site", {})
    before = logging.getLogger().handlers[:], logging.getLogger("changedetect").level
    main(["status", str(programme.directory), "--verbose", "--quiet"])
    assert (logging.getLogger().handlers[:], logging.getLogger("changedetect").level) == before


def test_json_documents_stay_one_document_when_logs_are_verbose(tmp_path, capsys):
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    assert run(capsys, "update", programme.directory, "--verbose")["n_due"] == 2


def test_the_program_runs_as_a_process_with_its_exit_code(tmp_path):
    command = [sys.executable, "-m", "changedetect.cli"]
    made = subprocess.run(
        [*command, "init", str(tmp_path / "site"), "--crs", CRS], capture_output=True, text=True, check=True
    )
    assert made.stdout.startswith("Made programme 'site'")
    again = subprocess.run(
        [*command, "init", str(tmp_path / "site"), "--crs", CRS], check=False, capture_output=True, text=True
    )
    assert (again.returncode, again.stdout) == (73, "")
    assert "exists" in again.stderr


def test_a_progress_bar_is_drawn_for_people_alone(tmp_path, capsys, monkeypatch):
    from changedetect.cli.session import Session

    with Session(command="update").progress() as on_progress:
        assert on_progress is None
    seen = []
    programme = make_programme(tmp_path / "site", {FIRST: {}})
    update(programme, on_progress=lambda done, total, label: seen.append((done, total, label)))
    assert seen == [(0, 2, f"model of {FIRST}"), (1, 2, f"maps of {FIRST}"), (2, 2, "done")]
