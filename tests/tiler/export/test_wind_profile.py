"""The undisturbed wind: profile, constants of k-epsilon that fit it, directions and sides."""

import math
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import ConfigError
from tiler.export.wind_profile import (
    C_1,
    C_2,
    C_MU,
    KAPPA,
    SIDES,
    SIGMA_EPSILON,
    Wind,
    flow_of,
    make_wind,
    split_sides,
)


def test_the_profile_has_the_speed_that_was_asked_for() -> None:
    wind = Wind(speed=6.0, height=10.0, roughness=0.1)
    # 0.41 * 6 / ln(101) = 0.53303
    assert wind.friction == pytest.approx(0.53303, abs=1e-5)
    assert wind.speed_at(10.0) == pytest.approx(6.0)
    assert wind.speed_at(0.0) == 0.0
    assert wind.k_at(0.0) == pytest.approx(0.53303**2 / 0.3, rel=1e-4)
    assert wind.epsilon_at(9.9) == pytest.approx(0.53303**3 / (0.41 * 10.0), rel=1e-4)


def test_the_profile_solves_the_equations_of_k_epsilon() -> None:
    """Stress is constant, production is dissipation, and the equation of epsilon is balanced by its diffusion."""
    wind = Wind(roughness=0.3)
    z, h = np.linspace(5.0, 50.0, 10), 1e-3
    viscosity = C_MU * wind.k_at(0.0) ** 2 / wind.epsilon_at(z)
    shear = (wind.speed_at(z + h) - wind.speed_at(z - h)) / (2 * h)
    assert np.allclose(viscosity * shear, wind.friction**2, rtol=1e-6)
    assert np.allclose(viscosity * shear**2, wind.epsilon_at(z), rtol=1e-6)

    def flux(height: np.ndarray) -> np.ndarray:
        slope = (wind.epsilon_at(height + h) - wind.epsilon_at(height - h)) / (2 * h)
        return C_MU * wind.k_at(0.0) ** 2 / wind.epsilon_at(height) / SIGMA_EPSILON * slope

    diffusion = (flux(z + h) - flux(z - h)) / (2 * h)
    source = (C_1 - C_2) * wind.epsilon_at(z) ** 2 / wind.k_at(0.0)
    assert np.allclose(diffusion, -source, rtol=1e-3)
    assert pytest.approx(1.16736, abs=1e-5) == SIGMA_EPSILON
    assert pytest.approx(KAPPA**2 / (0.48 * 0.3)) == SIGMA_EPSILON


@pytest.mark.parametrize(
    ("direction", "inlets", "outlets", "along"),
    [
        (0.0, ["north"], ["south"], ["west", "east"]),
        (90.0, ["east"], ["west"], ["south", "north"]),
        (180.0, ["south"], ["north"], ["west", "east"]),
        (270.0, ["west"], ["east"], ["south", "north"]),
        (240.0, ["west", "south"], ["east", "north"], []),
        (300.0, ["west", "north"], ["east", "south"], []),
        (45.0, ["east", "north"], ["west", "south"], []),
    ],
)
def test_sides_by_direction(direction: float, inlets: list[str], outlets: list[str], along: list[str]) -> None:
    assert split_sides(direction, SIDES) == (inlets, outlets, along)
    east, north = flow_of(direction)
    assert math.hypot(east, north) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"roughness": 0.0}, "--roughness 0: must be more than 0"),
        ({"wind_speed": -1.0}, "--wind-speed -1: must be more than 0"),
        ({"wind_height": math.inf}, "--wind-height inf: must be more than 0"),
        ({"direction": [240.0, 600.0]}, "--direction: 240, 240: give each once"),
        ({"direction": [math.nan]}, "--direction: must be degrees from north"),
        ({"patch_roughness": ["ground"]}, "--patch-roughness ground: must be PATCH=METRES"),
        ({"patch_roughness": ["ground=-1"]}, "--patch-roughness ground=-1: must be PATCH=METRES"),
    ],
)
def test_options_that_cannot_be(words: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_wind(words)  # type: ignore[arg-type]


TABLE = "height,speed,k\n0,0,1\n10,4,1\n50,6,0.5\n"


def test_a_table_is_the_profile(tmp_path: Path) -> None:
    path = tmp_path / "wind.csv"
    path.write_text(TABLE)
    wind = make_wind({"wind_table": str(path), "wind_height": 30.0, "roughness": 0.1})
    assert (wind.speed, wind.speed_at([5.0, 80.0]).tolist(), wind.k_at([30.0]).tolist()) == (
        5.0,
        [2.0, 6.0],
        [0.75],
    )
    path.write_text("speed,height\n" + "".join(f"{Wind(roughness=0.1).speed_at(z)},{z}\n" for z in (1, 9, 70)))
    alike = make_wind({"wind_table": str(path), "roughness": 0.1})
    assert alike.friction == pytest.approx(Wind(roughness=0.1).friction)
    assert alike.epsilon_at(9.0) == pytest.approx(Wind(roughness=0.1).epsilon_at(9.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its first line is ''; it must name height and speed"),
        ("height,speed,tke\n0,1,1\n", "its first line is 'height,speed,tke'"),
        ("height,speed\n0,1\n5,x\n", "line 3: 2 numbers are needed: 5,x"),
        ("height,speed\n0,1\n5\n", "line 3: 2 numbers are needed: 5"),
        ("height,speed\n0,1\n5,-2\n", "line 3: speed -2 must be 0 or more"),
        ("height,speed,k\n0,1,1\n5,2,0\n", "line 3: k 0 must be more than 0"),
        ("height,speed\n5,1\n5,2\n", "line 3: height 5 must be above 5 m"),
        ("height,speed\n5,1\n", "needs two heights or more"),
        ("height,speed\n0,0\n10,0\n20,3\n", "--wind-height 10: --wind-table has no speed there"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "wind.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        make_wind({"wind_table": str(path)})


def test_a_table_is_there_and_alone(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--wind-table .*none.csv: cannot be read"):
        make_wind({"wind_table": str(tmp_path / "none.csv")})
    with pytest.raises(ConfigError, match="--wind-speed: the speed is that of --wind-table"):
        make_wind({"wind_table": "any.csv", "wind_speed": 3.0})


def test_options_become_the_wind() -> None:
    assert make_wind({}) == Wind((270.0,), 5.0, 10.0, 0.5, {})
    wind = make_wind({"direction": [-90.0, 0.0], "roughness": 0.1, "patch_roughness": ["ground=0.03"]})
    assert wind.directions == (270.0, 0.0)
    assert wind.patches == {"ground": 0.03}
