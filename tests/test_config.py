"""Settings: defaults, layers, where values come from, and what is refused."""

from __future__ import annotations

import re
import tomllib
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from changedetect.config import (
    AdaptiveConfig,
    LWPRConfig,
    ProgrammeConfig,
    format_toml_value,
    load_config,
    profile_names,
)
from changedetect.config.schema import KEYS
from changedetect.errors import ConfigError, MissingInputError

REPOSITORY = Path(__file__).resolve().parents[1]
CRS = 'crs = "EPSG:32632"\n'


@pytest.fixture
def programme(tmp_path):
    """Return a function that writes programme.toml and loads it with a clean environment."""

    def load(text=CRS, environment=None, **arguments):
        (tmp_path / "programme.toml").write_text(text)
        return load_config(tmp_path, environment=environment or {}, **arguments)

    return load


def test_default_toml_states_every_key_with_its_built_in_default():
    table = tomllib.loads((REPOSITORY / "configs/default.toml").read_text())
    stated = {key: value for key, value in table.items() if not isinstance(value, dict)}
    stated |= {
        f"{name}.{key}": value for name, part in table.items() if isinstance(part, dict) for key, value in part.items()
    }
    expected = {
        dotted: "auto" if key.default is None else key.default for dotted, key in KEYS.items() if dotted != "crs"
    }
    assert stated == expected


def test_every_key_in_default_toml_carries_a_comment():
    lines = (REPOSITORY / "configs/default.toml").read_text().splitlines()
    bare = [line for line in lines if re.match(r"\w+ = ", line) and "#" not in line]
    assert bare == ["meta_rate = 250.0"]


def test_profiles_that_ship_load_and_are_named_in_the_default_file(programme):
    assert profile_names() == ["dem", "drone", "lidar"]
    resolutions = {name: programme(f'{CRS}profile = "{name}"\n').config.resolution for name in profile_names()}
    assert resolutions == {"dem": 1.0, "drone": 0.25, "lidar": 0.5}


def test_layers_overrule_each_other_in_the_stated_order(programme, tmp_path):
    extra = tmp_path / "extra.toml"
    extra.write_text("memory_days = 4\n[differencing]\nconfidence = 0.8\nchange_threshold_m = 0.4\n")
    text = CRS + 'profile = "drone"\nmemory_days = 3\n[differencing]\nconfidence = 0.7\n'
    environment = {"CHANGEDETECT_DIFFERENCING__CONFIDENCE": "0.9", "CHANGEDETECT_PAIRS": "first"}
    loaded = programme(text, environment, config_files=[extra], flags={"pairs": "all", "machine.workers": None})
    config, sources = loaded.config, loaded.sources
    assert (config.resolution, sources["resolution"]) == (0.25, "profile drone")
    assert (config.memory_days, sources["memory_days"]) == (4.0, str(extra))
    assert config.differencing.change_threshold_m == 0.4
    assert config.differencing.confidence == 0.9
    assert sources["differencing.confidence"] == "environment CHANGEDETECT_DIFFERENCING__CONFIDENCE"
    assert (config.pairs, sources["pairs"]) == ("all", "flag --pairs")
    assert (config.machine.workers, sources["machine.workers"]) == (0, "default.toml")
    assert sources["crs"].endswith("programme.toml")


def test_a_profile_named_by_a_stronger_layer_takes_the_place_of_the_programmes(programme):
    loaded = programme(CRS + 'profile = "drone"\n', {"CHANGEDETECT_PROFILE": "lidar"})
    assert loaded.config.resolution == 0.5


def test_other_environment_variables_with_the_prefix_are_ignored(programme):
    loaded = programme(environment={"CHANGEDETECT_DATA": "/data", "CHANGEDETECT_LWPR__NO_SUCH_KEY": "1"})
    assert loaded.config.lwpr == LWPRConfig()


def test_auto_in_a_stronger_layer_undoes_a_value(programme):
    text = CRS + "bounds = [0, 10, 0, 10]\n[adaptive]\nkernel_min_m = 0.5\n"
    loaded = programme(text, {"CHANGEDETECT_BOUNDS": "auto", "CHANGEDETECT_ADAPTIVE__KERNEL_MIN_M": "auto"})
    assert loaded.config.bounds is None
    assert loaded.config.adaptive.kernel_min_m is None


def test_bounds_come_from_files_and_from_the_environment(programme):
    assert programme(CRS + "bounds = [1, 2, 3, 4]\n").config.bounds == (1.0, 2.0, 3.0, 4.0)
    assert programme(environment={"CHANGEDETECT_BOUNDS": "[1, 2, 3, 5]"}).config.bounds == (1.0, 2.0, 3.0, 5.0)


def test_the_name_is_the_folders_where_none_is_given(programme, tmp_path):
    loaded = programme()
    assert (loaded.config.name, loaded.sources["name"]) == (tmp_path.name, "folder name")


def test_items_lists_every_key_with_value_and_source(programme):
    listed = {key: (value, source) for key, value, source in programme().items()}
    assert list(listed) == list(KEYS)
    assert listed["adaptive.kernel_ratio"] == (1.7, "default.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[adaptive]\nkernal_min_m = 1\n",
            r"\(line 3\): unknown key 'kernal_min_m' in section \[adaptive\]. Did you mean 'kernel_min_m'\? Allowed",
        ),
        ("resoluton = 1\n", r"\(line 2\): unknown key 'resoluton' in the top level. Did you mean 'resolution'\?"),
        ("confidence = 0.9\n", r"unknown key 'confidence' in the top level. It belongs in section \[differencing\]"),
        ("[machine]\npairs = 'all'\n", r"unknown key 'pairs' in section \[machine\]. It belongs in the top level"),
        ("[surface]\nkernel = 1\n", r"unknown key 'surface' in the top level"),
        ("lwpr = 3\n", r"\(line 2\): 'lwpr' is a section, write \[lwpr\]"),
        ("resolution = 0\n", r"\(line 2\): resolution = 0 is not valid: Input should be greater than 0"),
        ("resolution = nan\n", "resolution = nan is not valid"),
        ("resolution = true\n", "resolution = True is not valid"),
        ("[adaptive]\nkernel_ratio = 1\n", "adaptive.kernel_ratio = 1 is not valid: Input should be greater than 1"),
        (
            "[adaptive]\ncell_size_m = 'x'\n",
            "adaptive.cell_size_m = 'x' is not valid: Input should be a valid number or \"auto\"",
        ),
        (
            "[adaptive]\nkernel_min_m = 3\nkernel_max_m = 2\n",
            r"section \[adaptive\]: kernel_min_m = 3.0 is larger than kernel_max_m = 2.0",
        ),
        ("model = 'gpr'\n", "model = 'gpr' is not valid: Input should be 'adaptive' or 'reference'"),
        ("profile = 'drome'\n", "unknown profile 'drome'. Choose one of dem, drone, lidar"),
        ("bounds = [10, 0, 0, 10]\n", "west < east and south < north"),
        ("bounds = [0, 1, 2]\n", r"expected four numbers in metres, \[west, east, south, north\]"),
        ("format_version = 99\n", "format_version = 99 is not valid"),
        ("resolution =\n", "is not valid TOML: .*line 2"),
        ("[differencing]\nconfidence = 95\n", "differencing.confidence = 95 is not valid: Input should be less than 1"),
    ],
)
def test_a_wrong_setting_is_refused_with_file_key_and_what_is_allowed(programme, text, message):
    with pytest.raises(ConfigError, match=message):
        programme(CRS + text)


def test_all_wrong_values_of_a_section_are_told_at_once(programme):
    with pytest.raises(ConfigError) as caught:
        programme(CRS + "[adaptive]\nkernel_ratio = 9\nshrinkage = -1\n")
    assert "kernel_ratio" in str(caught.value)
    assert "shrinkage" in str(caught.value)


def test_a_wrong_variable_is_named(programme):
    with pytest.raises(ConfigError, match="environment CHANGEDETECT_RESOLUTION: resolution = 'fine' is not valid"):
        programme(environment={"CHANGEDETECT_RESOLUTION": "fine"})


def test_a_missing_crs_is_refused_with_an_example(programme):
    with pytest.raises(ConfigError, match=r'names no crs. Add a line such as crs = "EPSG:32632'):
        programme("resolution = 1\n")


def test_a_missing_config_file_is_missing_input(programme, tmp_path):
    with pytest.raises(MissingInputError, match=r"There is no file '.*absent.toml'"):
        programme(config_files=[tmp_path / "absent.toml"])


def test_fingerprints_follow_science_and_not_the_machine():
    config = ProgrammeConfig(crs="EPSG:32632")
    same = replace(config, name="other", pairs="all", machine=replace(config.machine, workers=7))
    assert same.config_sha256 == config.config_sha256
    assert replace(config, memory_days=1.0).learning_sha256 != config.learning_sha256
    differencing = replace(config.differencing, confidence=0.9)
    changed = replace(config, differencing=differencing)
    assert changed.learning_sha256 == config.learning_sha256
    assert changed.config_sha256 != config.config_sha256


def test_settings_of_the_mode_not_in_use_do_not_count():
    adaptive = ProgrammeConfig(crs="EPSG:32632")
    reference = replace(adaptive, model="reference")
    lwpr = replace(adaptive.lwpr, activation_threshold=0.2)
    assert replace(adaptive, lwpr=lwpr).config_sha256 == adaptive.config_sha256
    assert replace(reference, lwpr=lwpr).config_sha256 != reference.config_sha256


def test_the_fingerprint_is_that_of_earlier_versions():
    # Another value makes every stored model stale: change it only together with what the settings mean.
    adaptive = AdaptiveConfig(
        cell_size_m=0.25,
        kernel_min_m=0.5,
        kernel_max_m=16.0,
        kernel_ratio=1.5,
        lattice_spacing=0.75,
        shrinkage=1.0,
        prior_observations=1.0,
    )
    config = ProgrammeConfig(crs="EPSG:32632", resolution=0.5, bounds=(0.0, 9.0, 0.0, 8.0), adaptive=adaptive)
    assert config.learning_sha256 == "7d3437e577700f319ae9e5bfa73ade3ed3575ac29c478642e1bd96d6cd792067"


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(AttributeError):
        AdaptiveConfig().kernel_ratio = 2.0


def test_lwpr_settings_agree_with_the_reference_model():
    from changedetect.models.reference import ReferenceSettings

    defaults = {field.name: field.default for field in fields(ReferenceSettings)}
    assert {name: defaults[name] for name in asdict(LWPRConfig())} == asdict(LWPRConfig())


@pytest.mark.parametrize("value", [1, 0.1, True, 'a "quoted" \\ text\nä\x7f', (1.5, 2), ["x", "y"]])
def test_values_written_as_toml_read_back(value):
    read = tomllib.loads(f"value = {format_toml_value(value)}")["value"]
    assert read == (list(value) if isinstance(value, tuple) else value)
