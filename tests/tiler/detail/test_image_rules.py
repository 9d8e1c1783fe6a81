"""`citystitch facade-rules`: storeys, bays and windows of drawn façades, and a house by the rules."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.benchmarks.facade_rhythm import FACADES, draw
from tests.tiler.cityinput.models import house_json, write_json
from tiler.cli.main import main


@pytest.mark.parametrize("k", range(len(FACADES)))
def test_rules_of_an_image_have_its_storeys_bays_and_windows(k: int, tmp_path: Path) -> None:
    known, rules = FACADES[k], tmp_path / "rules.json"
    Image.fromarray(draw(known, k)).save(tmp_path / "a.png")
    words = ["facade-rules", str(tmp_path / "a.png"), "--size", f"{known.width},{known.height}", "-o", str(rules)]
    assert main(words) == 0
    document = json.loads(rules.read_text())
    nodes = document["nodes"]
    assert nodes["storeys"]["size"] == pytest.approx(known.storey, rel=0.01)
    assert nodes["bays"]["size"] == pytest.approx(known.bay, rel=0.01)
    window = [nodes["window"][key] for key in ("width", "height", "sill")]
    assert window == pytest.approx(known.window, abs=0.15)
    margins = sum(part.get("size", 0) for part in nodes["facade"]["parts"])
    assert (known.height - margins) / known.storey == pytest.approx(known.storeys, abs=0.05)
    # By hand: a door in the ground floor, which the image shows as shops.
    if known.shops:
        nodes["ground"]["parts"] = [{"share": 1}, {"size": 2, "to": "door"}, {"share": 1}]
        nodes["door"] = {"op": "insert", "asset": "door", "width": 1.2, "height": 2.3}
        nodes["facade"]["parts"][0]["size"] = 3.0
        nodes["storeys"]["size"] = 1.0
        nodes["window"] |= {"height": 0.5, "sill": 0.2}
        rules.write_text(json.dumps(document))
        house = write_json(tmp_path / "in.city.json", house_json())
        out = tmp_path / "out.city.json"
        assert main(["detail", str(house), "--rules", str(rules), "-o", str(out)]) == 0
        (solid,) = json.loads(out.read_text())["CityObjects"]["house"]["geometry"]
        kinds = [surface["type"] for surface in solid["semantics"]["surfaces"]]
        assert {"Door", "Window"} <= set(kinds)


def test_an_image_without_rhythm_is_one_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 300, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    words = ["facade-rules", str(tmp_path / "a.png"), "-o", str(tmp_path / "r.json"), "--size"]
    assert main([*words, "20,20"]) == 1
    assert "nothing repeats" in capsys.readouterr().err
    assert main([*words, "20"]) == 2
    assert "is not WIDTH,HEIGHT" in capsys.readouterr().err
    assert not (tmp_path / "r.json").exists()
