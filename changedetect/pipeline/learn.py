"""Learning the model of an epoch from that of its parent and its own points."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from typing import Any, Literal, TypeAlias

import numpy as np

import changedetect
from changedetect.catalogue import (
    AlignmentRecord,
    Epoch,
    Programme,
    SourceRecord,
    StateRecord,
    describe_files,
    own_state_reasons,
)
from changedetect.errors import ModelStateError
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR
from changedetect.models.registry import create_model, load_model
from changedetect.pipeline.alignment import align_epoch
from changedetect.pipeline.manifest import utc_now
from changedetect.pipeline.reading import read_epoch_points
from changedetect.pipeline.regions import join_regions
from changedetect.storage import atomic_directory
from changedetect.typing import Region

__all__ = ["Model", "ModelShelf", "learn_epoch", "learned_region"]

logger = logging.getLogger(__name__)

Model: TypeAlias = LWPRSurface | ReferenceLWPR


@dataclass(frozen=True)
class _Learned:
    """A model, the sources its epoch was learned from, how they were aligned, and whether they were read again."""

    model: Model
    sources: tuple[SourceRecord, ...]
    alignment: AlignmentRecord | None
    n_points: int
    origin: Literal["sources", "stored evidence"]


class ModelShelf:
    """
    Models of a programme, loaded when first needed; the few used last stay in memory.

    Parameters
    ----------
    programme : Programme
    capacity : int
        Two epochs of a difference, and the first, which the others are aligned to.
    """

    def __init__(self, programme: Programme, capacity: int = 3) -> None:
        self._programme = programme
        self._capacity = capacity
        self._models: OrderedDict[str, Model] = OrderedDict()

    def put(self, epoch_id: str, model: Model) -> None:
        """Keep a model that was just learned."""
        self._models[epoch_id] = model
        self._models.move_to_end(epoch_id)
        while len(self._models) > self._capacity:
            self._models.popitem(last=False)

    def get(self, epoch_id: str) -> Model:
        """
        Return the model of an epoch; not to be modified.

        Raises
        ------
        ModelStateError
            The stored model is damaged.
        """
        if epoch_id not in self._models:
            self.put(epoch_id, load_model(self._programme.state_directory(epoch_id)))
        self._models.move_to_end(epoch_id)
        return self._models[epoch_id]


def learn_epoch(
    programme: Programme, epoch: Epoch, parent: Epoch | None, reference_id: str | None, models: ModelShelf
) -> dict[str, Any]:
    """
    Learn the model of an epoch and put it in place of an older one, whole.

    Parameters
    ----------
    programme : Programme
    epoch : Epoch
    parent : Epoch or None
        The epoch before, learned already; None where this is the first.
    reference_id : str or None
        The first epoch, which later ones are aligned to; None where this is it.
    models : ModelShelf
        Gives the models of these, receives the new one.

    Returns
    -------
    details : dict
        For the run's manifest.

    Raises
    ------
    MissingInputError, InputDataError
        The sources cannot be used; what was learned before stays.

    Notes
    -----
    Where nothing but the parent has changed, the model is put on its new parent from its own evidence, without reading
    the sources again, if its kind keeps evidence. Evidence is that of the aligned points; it stays valid because the
    alignment follows from the sources of this and the first epoch and from the settings alone, not from the epochs in
    between, whose memory the model of the first epoch does not have.
    """
    learned = _rebuild(programme, epoch, parent, reference_id, models)
    learned = learned or _learn_points(programme, epoch, parent, reference_id, models)
    _write_state(programme, epoch, parent, learned)
    models.put(epoch.epoch_id, learned.model)
    ratio, settings = None, None
    if isinstance(learned.model, LWPRSurface):
        ratio, settings = learned.model.stated_sigma_ratio(), learned.model.chosen_settings()
        logger.info("%s: chosen from the density: %s.", epoch.epoch_id, _in_words(settings))
    if ratio is not None:
        logger.info("%s: the noise found is %.2f times the stated sigma.", epoch.epoch_id, ratio)
    return {
        "parent": parent.epoch_id if parent else None,
        "n_points": learned.n_points,
        "origin": learned.origin,
        "sigma_ratio": ratio,
        "settings": settings,
        "alignment": None if learned.alignment is None else asdict(learned.alignment),
        "warnings": [] if learned.alignment is None else list(learned.alignment.warnings),
        "sources": [{"uri": item.uri, "sha256": item.sha256, "n_used": item.n_used} for item in learned.sources],
    }


def _in_words(settings: dict[str, float]) -> str:
    return ", ".join(f"{name.removesuffix('_m')} {value:.3g} m" for name, value in settings.items())


def _learn_points(
    programme: Programme, epoch: Epoch, parent: Epoch | None, reference_id: str | None, models: ModelShelf
) -> _Learned:
    points = read_epoch_points(programme, epoch)
    cloud, alignment = points.cloud, None
    model = models.get(parent.epoch_id).copy() if parent else create_model(programme.config)
    if isinstance(model, LWPRSurface):
        kept = model.without_gross_errors(cloud.coordinates, cloud.elevation)
        if not kept.all():
            n_left_out = int(kept.size - np.count_nonzero(kept))
            logger.info("%s: %d of %d points stand alone and are left out.", epoch.epoch_id, n_left_out, kept.size)
            cloud = cloud.select(kept)
    if reference_id is not None and programme.config.coregistration.enabled:
        cloud, alignment = align_epoch(programme, epoch, reference_id, cloud, models.get(reference_id))
    model.partial_fit(cloud.coordinates, cloud.elevation, cloud.sigma, epoch.survey_time)
    return _Learned(model, points.records, alignment, len(points.cloud), "sources")


def _rebuild(
    programme: Programme, epoch: Epoch, parent: Epoch | None, reference_id: str | None, models: ModelShelf
) -> _Learned | None:
    """Put the epoch's stored model on its new parent; None where the sources have to be read."""
    points = programme.reconstruction_record(epoch.epoch_id) if epoch.flight is not None else None
    if own_state_reasons(programme, epoch, reference_id, points and points[1]):
        return None
    found = programme.state_record(epoch.epoch_id)
    try:
        model = load_model(programme.state_directory(epoch.epoch_id))
    except ModelStateError as error:
        logger.warning("%s Learning from the sources instead.", error)
        return None
    parent_model = models.get(parent.epoch_id) if parent else None
    if found is None or not isinstance(model, LWPRSurface) or not isinstance(parent_model, LWPRSurface | None):
        return None
    record = found[0]
    rebuilt = model.rebuilt_on(parent_model)
    return _Learned(rebuilt, record.sources, record.alignment, record.n_points, "stored evidence")


def _write_state(programme: Programme, epoch: Epoch, parent: Epoch | None, learned: _Learned) -> None:
    parent_record = programme.state_record(parent.epoch_id) if parent else None
    config = programme.config
    with atomic_directory(programme.state_directory(epoch.epoch_id)) as temporary:
        learned.model.save(temporary)
        StateRecord(
            epoch_id=epoch.epoch_id,
            mode=config.model,
            survey_time=epoch.survey_time,
            parent=parent.epoch_id if parent else None,
            parent_sha256=parent_record[1] if parent_record else None,
            settings=config.learning_settings,
            learning_sha256=config.learning_sha256,
            config_sha256=config.config_sha256,
            sources=learned.sources,
            alignment=learned.alignment,
            n_points=learned.n_points,
            region=learned.model.region,
            files=describe_files(temporary),
            software_version=changedetect.__version__,
            created=utc_now(),
        ).write(temporary)


def learned_region(programme: Programme, epoch_ids: Sequence[str]) -> Region:
    """
    Ground that the models of epochs hold together, as their manifests say.

    Raises
    ------
    ModelStateError
        A model has no manifest.
    """
    regions = []
    for epoch_id in epoch_ids:
        found = programme.state_record(epoch_id)
        if found is None:
            msg = (
                f"'{programme.state_directory(epoch_id)}' has no manifest. Learn the epoch again: changedetect update "
                f"{programme.directory}"
            )
            raise ModelStateError(msg)
        regions.append(found[0].region)
    return reduce(join_regions, regions)
