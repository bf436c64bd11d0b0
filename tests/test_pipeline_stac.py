"""The programme's catalogue: complete after every update, without dead links, checked by verify."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pystac
import pytest
from small_surveys import add_by_hand, make_programme, reopen, snapshot

from changedetect.catalogue import Programme
from changedetect.cli import main
from changedetect.pipeline.update import update
from changedetect.pipeline.verify import verify
from changedetect.pipeline.withdraw import withdraw_epoch
from changedetect.storage import read_json

FIRST, SECOND, THIRD = "2024-01-01", "2024-07-01", "2025-01-01"


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    surveys = {FIRST: {"n_points": 900}, SECOND: {"n_points": 900, "step": 0.5}}
    programme = make_programme(tmp_path_factory.mktemp("stac") / "site", surveys, resolution=1.0)
    assert update(programme).exit_code == 0
    return programme


@pytest.fixture
def site(learned, tmp_path):
    shutil.copytree(learned.directory, tmp_path / "site", copy_function=shutil.copy2)
    return Programme.open(tmp_path / "site", environment={})


def products(programme):
    return programme.directory / "products"


def catalogue(programme):
    return pystac.Catalog.from_file(str(products(programme) / "catalog.json"))


def ids(programme):
    return {item.id for item in catalogue(programme).get_items(recursive=True)}


def documents(programme):
    return sorted(products(programme).rglob("*.json"))


def test_pystac_walks_from_the_root_to_every_asset(learned):
    root = catalogue(learned)
    assert ids(learned) == {f"site-{FIRST}", f"site-{SECOND}", f"site-{FIRST}-{SECOND}-dod"}
    for item in root.get_items(recursive=True):
        assert item.get_root().id == root.id
        assert item.get_collection().id == "site"
        for asset in item.get_assets().values():
            assert Path(asset.get_absolute_href()).is_file()


def test_no_link_leaves_the_folder_of_products(learned):
    for path in documents(learned):
        document = read_json(path)
        hrefs = [link["href"] for link in document.get("links", [])]
        hrefs += [asset["href"] for asset in document.get("assets", {}).values()]
        for href in hrefs:
            assert not href.startswith(("/", "http", "file"))
            target = (path.parent / href).resolve()
            assert target.is_file()
            assert target.is_relative_to(products(learned).resolve())


def test_a_copy_of_the_products_is_a_catalogue_too(learned, tmp_path):
    shutil.copytree(products(learned), tmp_path / "elsewhere")
    root = pystac.Catalog.from_file(str(tmp_path / "elsewhere" / "catalog.json"))
    assert len(list(root.get_items(recursive=True))) == 3


def test_lineage_leads_from_a_change_to_both_epochs_and_from_an_epoch_to_the_one_before(learned):
    by_id = {item.id: item for item in catalogue(learned).get_items(recursive=True)}
    origins = {
        name: sorted(pystac.Item.from_file(link.get_absolute_href()).id for link in item.get_links("derived_from"))
        for name, item in by_id.items()
    }
    assert origins[f"site-{FIRST}-{SECOND}-dod"] == [f"site-{FIRST}", f"site-{SECOND}"]
    assert origins[f"site-{SECOND}"] == [f"site-{FIRST}"]
    assert origins[f"site-{FIRST}"] == []
    source = learned.state_record(FIRST)[0].sources[0]
    assert source.sha256 in by_id[f"site-{FIRST}"].properties["processing:lineage"]


def test_a_new_epoch_enters_the_catalogue(site):
    add_by_hand(site.directory, THIRD, seed=8, n_points=900)
    assert update(reopen(site)).exit_code == 0
    assert ids(site) >= {f"site-{THIRD}", f"site-{SECOND}-{THIRD}-dod", f"site-{FIRST}-{THIRD}-dod"}
    assert len(ids(site)) == 6
    interval = read_json(products(site) / "collection.json")["extent"]["temporal"]["interval"]
    assert interval == [[f"{FIRST}T00:00:00Z", f"{THIRD}T00:00:00Z"]]
    assert verify(reopen(site)) == ()


def test_a_withdrawn_epoch_leaves_the_catalogue_at_once(site):
    withdraw_epoch(site, SECOND)
    assert ids(site) == {f"site-{FIRST}"}
    assert verify(reopen(site)) == ()


def test_a_programme_without_products_has_no_catalogue(site):
    withdraw_epoch(site, SECOND)
    withdraw_epoch(reopen(site), FIRST)
    assert documents(site) == []


def test_an_update_with_nothing_due_touches_nothing(site):
    before = snapshot(site.directory)
    assert update(reopen(site)).run_id is None
    assert snapshot(site.directory) == before


@pytest.mark.parametrize("name", ["collection.json", "catalog.json"])
def test_a_lost_or_changed_document_is_found_and_written_anew(site, name):
    path = products(site) / name
    right = path.read_bytes()
    for damage in (path.unlink, lambda: path.write_text("{"), lambda: path.write_text('{"links": []}')):
        damage()
        (finding,) = verify(reopen(site))
        assert (finding.severity, finding.subject) == ("error", f"products/{name}")
        assert update(reopen(site)).run_id is None
        assert path.read_bytes() == right
        assert verify(reopen(site)) == ()


def test_verify_sees_an_item_that_lies(site, capsys):
    path = products(site) / FIRST / "item.json"
    item = read_json(path)
    item["assets"]["elevation"]["file:checksum"] = "1220" + "0" * 64
    path.write_text(json.dumps(item))
    messages = [finding.message for finding in verify(reopen(site)) if "item.json" in finding.subject]
    assert any("another checksum" in message for message in messages)
    assert main(["verify", str(site.directory)]) == 65
    capsys.readouterr()


def test_products_made_elsewhere_stand_alone(site, tmp_path, capsys):
    assert main(["diff", str(site.directory), FIRST, SECOND, "-o", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    item = pystac.Item.from_file(str(tmp_path / "out" / "item.json"))
    assert item.collection_id is None
    assert [link for link in item.links if link.rel != "self"] == []
    assert all(Path(asset.get_absolute_href()).is_file() for asset in item.get_assets().values())
