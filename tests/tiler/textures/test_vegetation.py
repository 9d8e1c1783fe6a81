"""`citystitch vegetation`: a classifier of drawn streets, and plants that hide what is behind them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.helpers.street_pictures import draw_street
from tiler.cli.main import main
from tiler.textures.vegetation import find_plants, read_classifier

pytest.importorskip("sklearn", reason="needs the extra textures")


def test_a_classifier_of_some_streets_finds_the_trees_of_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images, masks = tmp_path / "images", tmp_path / "masks"
    images.mkdir()
    masks.mkdir()
    for seed in (0, 3, 4):
        pixels, trees = draw_street(seed)
        Image.fromarray(pixels).save(images / f"{seed}.png")
        Image.fromarray(trees.astype(np.uint8) * 255).save(masks / f"{seed}.png")
    words = ["vegetation", str(images), "--masks", str(masks), "-o", str(tmp_path / "a.json")]
    assert main(words) == 0
    told = capsys.readouterr().out
    stated = json.loads((tmp_path / "a.json").read_text())["leave_one_out"]
    assert f"leave-one-out accuracy: {100 * stated:.1f} % of 3 images" in told
    assert stated > 0.9
    pixels, trees = draw_street(6)
    plants = np.kron(find_plants(read_classifier(tmp_path / "a.json"), pixels), np.ones((15, 15)))[:300, :400]
    assert (plants.astype(bool) == trees).mean() > 0.9
    (masks / "4.png").write_bytes((masks / "4.png").read_bytes()[:200])
    for k in (0, 3):
        Image.fromarray(np.zeros((300, 400), np.uint8)).save(masks / f"{k}.png")
    capsys.readouterr()
    assert main([*words, "--overwrite"]) == 1
    assert "4.png: cannot be read" in capsys.readouterr().err
    (masks / "4.png").unlink()
    assert main([*words, "--overwrite"]) == 1
    assert "show no plants" in capsys.readouterr().err
    assert main(["texture", str(tmp_path), "--cameras", "x", "--images", str(images), "-o", str(tmp_path / "o"),
                 "--vegetation", str(masks / "0.png")]) == 1  # fmt: skip
    assert "is no classifier" in capsys.readouterr().err
