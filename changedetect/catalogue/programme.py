"""A monitoring programme as a folder: settings, epochs, and where their models and products lie."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Self

from changedetect.catalogue.epoch import Epoch, read_epoch, write_epoch
from changedetect.catalogue.records import ProductRecord, ReconstructionRecord, StateRecord
from changedetect.config import (
    FORMAT_VERSION,
    PROGRAMME_FILE,
    LoadedConfig,
    ProgrammeConfig,
    format_toml_value,
    load_config,
)
from changedetect.crs import check_programme_crs
from changedetect.errors import ConfigError, InputDataError, MissingInputError, ModelStateError, OutputExistsError
from changedetect.storage import atomic_path

__all__ = ["POINTS_FOLDER", "STEPS_FOLDER", "ChangeProduct", "Programme"]

logger = logging.getLogger(__name__)

#: Folders in `flights/EPOCH_ID/`: points with their manifest, whole or absent; steps, which may be deleted.
POINTS_FOLDER, STEPS_FOLDER = "points", "steps"
#: Folders of a programme that only its own commands write into.
_KEPT_FOLDERS = ("epochs", "flights", "products", "runs", "sources", "state")


@dataclass(frozen=True)
class ChangeProduct:
    """The difference of two epochs: later minus earlier."""

    earlier: str
    later: str

    @property
    def product_id(self) -> str:
        """Name of its folder."""
        return f"{self.earlier}_{self.later}"


@dataclass(frozen=True)
class Programme:
    """
    A site's epochs and rules.

    Attributes
    ----------
    directory : Path
    loaded : LoadedConfig
        Settings, each with the place it came from.
    """

    directory: Path
    loaded: LoadedConfig

    @classmethod
    def create(
        cls, directory: Path, settings: Mapping[str, Any], *, overwrite: bool = False, dry_run: bool = False
    ) -> Self:
        """
        Make a programme folder with a `programme.toml`.

        Parameters
        ----------
        directory : Path
            Made where missing; other files in it are left alone.
        settings : mapping
            Top-level keys of `programme.toml`; None values are left out. `crs` is needed.
        overwrite : bool
            Replace an existing `programme.toml`; epochs and results stay.
        dry_run : bool
            Check everything and write nothing.

        Raises
        ------
        OutputExistsError
            There is a programme already.
        ConfigError
            A setting is not allowed.
        CRSMismatchError
            The CRS is unknown, or not projected in metres.
        OutputError
            The folder cannot be written.
        """
        path = directory / PROGRAMME_FILE
        if path.exists() and not overwrite:
            msg = f"'{path}' exists: the programme has been made before. Edit the file, or pass --overwrite."
            raise OutputExistsError(msg)
        given = {key: value for key, value in settings.items() if value is not None}
        config = load_config(directory, environment={}, programme=given).config
        check_programme_crs(config.crs)
        if not dry_run:
            with atomic_path(path) as temporary:
                temporary.write_text(_programme_text(given, config), encoding="utf-8")
        return cls(directory, load_config(directory, programme=given if dry_run else None))

    @classmethod
    def open(
        cls,
        directory: Path,
        *,
        config_files: Sequence[Path] = (),
        environment: Mapping[str, str] | None = None,
        flags: Mapping[str, Any] | None = None,
    ) -> Self:
        """
        Open a programme folder.

        Raises
        ------
        MissingInputError
            There is no programme.
        ConfigError
            A setting is unknown or not allowed.
        CRSMismatchError
            The CRS is unknown, or not projected in metres.
        """
        if not (directory / PROGRAMME_FILE).is_file():
            msg = (
                f"'{directory}' is no programme: there is no {PROGRAMME_FILE} in it. "
                f"Make one with: changedetect init {directory} --crs EPSG:..."
            )
            raise MissingInputError(msg)
        loaded = load_config(directory, config_files=config_files, environment=environment, flags=flags)
        check_programme_crs(loaded.config.crs)
        return cls(directory, loaded)

    @property
    def config(self) -> ProgrammeConfig:
        """Settings of the programme."""
        return self.loaded.config

    @property
    def lock_path(self) -> Path:
        """File that a run holds locked."""
        return self.directory / ".lock"

    @property
    def runs_directory(self) -> Path:
        """Where runs leave their manifests."""
        return self.directory / "runs"

    @property
    def stable_areas_path(self) -> Path | None:
        """File of polygons that do not change, if the settings name one."""
        name = self.config.coregistration.stable_areas
        return None if name is None else self.directory / Path(name).expanduser()

    def keeps(self, path: Path) -> Path | None:
        """Folder of the programme that a path lies in, or is, and that only its own commands write into; else None."""
        kept = [self.directory / name for name in _KEPT_FOLDERS]
        return next((folder for folder in kept if path.resolve().is_relative_to(folder.resolve())), None)

    def state_directory(self, epoch_id: str) -> Path:
        """Where the model of an epoch lies."""
        return self.directory / "state" / epoch_id

    def flight_directory(self, epoch_id: str) -> Path:
        """Where the points made from the flight of an epoch lie, and the steps that led to them."""
        return self.directory / "flights" / epoch_id

    def product_directory(self, product_id: str) -> Path:
        """Where the products of an epoch, or of two (`EARLIER_LATER`), lie."""
        return self.directory / "products" / product_id

    def sources_directory(self, epoch_id: str) -> Path:
        """Where sources that `add --move` took in lie."""
        return self.directory / "sources" / epoch_id

    def epoch_path(self, epoch_id: str) -> Path:
        """File that describes an epoch."""
        return self.directory / "epochs" / f"{epoch_id}.toml"

    @cached_property
    def epochs(self) -> tuple[Epoch, ...]:
        """
        All epochs by date.

        Raises
        ------
        ConfigError
            A file in `epochs/` is not valid, two epochs have the same date, or two products the same name.
        """
        found = [read_epoch(path) for path in sorted((self.directory / "epochs").glob("*.toml"))]
        return _in_order(found)

    def epoch(self, epoch_id: str) -> Epoch:
        """
        Return one epoch.

        Raises
        ------
        MissingInputError
            The programme has no such epoch.
        """
        for epoch in self.epochs:
            if epoch.epoch_id == epoch_id:
                return epoch
        known = ", ".join(epoch.epoch_id for epoch in self.epochs) or "none yet; add one with `changedetect add`"
        msg = f"'{self.directory}' has no epoch '{epoch_id}'. Its epochs: {known}."
        raise MissingInputError(msg)

    def with_epoch(self, epoch: Epoch) -> tuple[Epoch, ...]:
        """Return all epochs by date with `epoch` among them, in place of an older one of the same id; see `epochs`."""
        return _in_order([*(known for known in self.epochs if known.epoch_id != epoch.epoch_id), epoch])

    def write_epoch(self, epoch: Epoch) -> Self:
        """Write an epoch's file and return the programme that has it."""
        self.with_epoch(epoch)
        write_epoch(self.epoch_path(epoch.epoch_id), epoch)
        return type(self)(self.directory, self.loaded)

    def pairs(self, rule: str | None = None, epoch_ids: Sequence[str] | None = None) -> tuple[ChangeProduct, ...]:
        """
        Return the differences that a rule asks for.

        Parameters
        ----------
        rule : {"consecutive", "first", "all"}, optional
            The programme's own by default: neighbours in time, and the first with the last; each with the first;
            every two.
        epoch_ids : sequence of str, optional
            Epochs in order; all of the programme by default.
        """
        ids = [epoch.epoch_id for epoch in self.epochs] if epoch_ids is None else list(epoch_ids)
        rule = self.config.pairs if rule is None else rule
        if rule == "all":
            chosen = list(combinations(ids, 2))
        elif rule == "first":
            chosen = [(ids[0], later) for later in ids[1:]]
        else:
            chosen = list(pairwise(ids))
            if len(ids) > 2:
                chosen.append((ids[0], ids[-1]))
        return tuple(ChangeProduct(earlier, later) for earlier, later in chosen)

    def pair(self, earlier: str, later: str) -> ChangeProduct:
        """
        Return the difference of two epochs.

        Raises
        ------
        MissingInputError
            An epoch does not exist.
        InputDataError
            The epochs are the same, or not in the order of time.
        """
        times = [self.epoch(epoch_id).survey_time for epoch_id in (earlier, later)]
        if times[0] >= times[1]:
            if times[0] > times[1]:
                fix = f"Name them in this order: {later} {earlier}."
            else:
                fix = "Name two epochs of different dates."
            msg = (
                f"A difference goes from an earlier epoch to a later one, not from '{earlier}' "
                f"({self.epoch(earlier).date_text}) to '{later}' ({self.epoch(later).date_text}). {fix}"
            )
            raise InputDataError(msg)
        return ChangeProduct(earlier, later)

    def state_record(self, epoch_id: str) -> tuple[StateRecord, str] | None:
        """Manifest of an epoch's model and its SHA-256; None where the epoch has not been learned."""
        return StateRecord.read(self.state_directory(epoch_id))

    def intact_state_record(self, epoch_id: str) -> StateRecord | None:
        """Manifest of an epoch's model; None, with a logged warning, where it is damaged."""
        try:
            found = self.state_record(epoch_id)
        except ModelStateError as error:
            logger.warning("%s", error)
            return None
        return found[0] if found else None

    def reconstruction_record(self, epoch_id: str) -> tuple[ReconstructionRecord, str] | None:
        """Manifest of the points made from an epoch's flight and its SHA-256; None where there are none."""
        return ReconstructionRecord.read(self.flight_directory(epoch_id) / POINTS_FOLDER)

    def product_record(self, product_id: str) -> tuple[ProductRecord, str] | None:
        """Manifest of a folder of products and its SHA-256; None where there is none."""
        return ProductRecord.read(self.product_directory(product_id))

    def existing_pairs(self) -> tuple[ChangeProduct, ...]:
        """Return the differences that have a folder in `products/`, of epochs the programme has."""
        folders = {path.name for path in (self.directory / "products").glob("*") if path.is_dir()}
        return tuple(pair for pair in self.pairs("all") if pair.product_id in folders)


def _in_order(epochs: Sequence[Epoch]) -> tuple[Epoch, ...]:
    ordered = sorted(epochs, key=lambda epoch: (epoch.date, epoch.epoch_id))
    for one, other in pairwise(ordered):
        if one.date == other.date:
            msg = (
                f"Epochs '{one.epoch_id}' and '{other.epoch_id}' have the same date, {one.date_text}. "
                "Give each its time, like 2024-05-01T14:30, or put their sources into one epoch."
            )
            raise ConfigError(msg)
    ids = [epoch.epoch_id for epoch in ordered]
    folders: dict[str, str] = {epoch_id: f"epoch {epoch_id}" for epoch_id in ids}
    for earlier, later in combinations(ids, 2):
        product_id, meaning = ChangeProduct(earlier, later).product_id, f"the difference of {earlier} and {later}"
        if product_id in folders:
            msg = (
                f"The folder products/{product_id} would hold both {folders[product_id]} and {meaning}. "
                "Choose epoch ids without '_'."
            )
            raise ConfigError(msg)
        folders[product_id] = meaning
    return tuple(ordered)


def _programme_text(given: Mapping[str, Any], config: ProgrammeConfig) -> str:
    lines = [
        "# Settings of this monitoring programme. All settings and their values: changedetect config show .",
        f"format_version = {FORMAT_VERSION}",
        f"name = {format_toml_value(config.name)}",
        f"crs = {format_toml_value(config.crs)}",
        f"resolution = {format_toml_value(config.resolution)}  # m, cell size of the rasters",
    ]
    written = {"format_version", "name", "crs", "resolution"}
    lines += [f"{key} = {format_toml_value(value)}" for key, value in given.items() if key not in written]
    return "\n".join(lines) + "\n"
