"""Rules that houses are drawn by: a distribution for each parameter, and presets."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.architecture.parameters import PLANS, ROOF_SHAPES

Value = float | str
_TRIES = 100  # draws of a normal distribution until one lies within its limits


@dataclass(frozen=True)
class Distribution:
    """How a parameter is drawn."""

    kind: str  #: ``"constant"``, ``"uniform"``, ``"normal"`` or ``"choice"``
    #: the constant; least and greatest; mean, standard deviation, least and greatest; or what is chosen from
    values: tuple[Value, ...]
    weights: tuple[float, ...] = ()  #: of each choice, summed up and over their sum

    def draw(self, rng: np.random.Generator) -> Value:
        """Draw a value."""
        if self.kind == "constant":
            return self.values[0]
        if self.kind == "choice":
            return self.values[int(np.searchsorted(self.weights, rng.random(), side="right"))]
        numbers = [float(value) for value in self.values]
        if self.kind == "uniform":
            return float(rng.uniform(numbers[0], numbers[1]))
        mean, sigma, low, high = numbers
        for _ in range(_TRIES):
            value = float(rng.normal(mean, sigma))
            if low <= value <= high:
                return value
        return min(max(mean, low), high)

    def limits(self) -> tuple[float, float]:
        """Least and greatest number that may be drawn."""
        if self.kind == "normal":
            return float(self.values[2]), float(self.values[3])
        numbers = [float(value) for value in self.values]
        return min(numbers), max(numbers)


# What each rule may give: least and greatest number, or words.
SIZES: dict[str, tuple[float, float]] = {
    "length": (3.0, 300.0),
    "width": (3.0, 300.0),
    "wing": (3.0, 50.0),
    "storeys": (1.0, 200.0),
    "storey_height": (2.0, 10.0),
    "roof_pitch": (3.0, 70.0),
    "overhang": (0.0, 2.0),
    "embrasure": (0.0, 0.5),
    "wall_thickness": (0.05, 1.0),
    "garage": (0.0, 1.0),
    "alcove": (0.0, 1.0),
    "dormers": (0.0, 20.0),
    "dormer_width": (0.8, 10.0),
    "dormer_height": (0.5, 4.0),
    "dormer_gabled": (0.0, 1.0),
    "chimney": (0.0, 1.0),
    "roof_windows": (0.0, 20.0),
    "window_width": (0.3, 5.0),
    "window_height": (0.3, 4.0),
    "window_distance": (0.2, 20.0),
    "door_width": (0.6, 5.0),
    "door_height": (1.5, 5.0),
    "year": (1.0, 2100.0),
}
WORDS: dict[str, tuple[str, ...] | None] = {"footprint": PLANS, "roof_shape": ROOF_SHAPES, "use": None}

_DETACHED: dict[str, Any] = {
    "footprint": "rectangle",
    "length": {"uniform": [9.0, 14.0]},
    "width": {"uniform": [7.0, 9.5]},
    "wing": {"uniform": [5.0, 7.0]},
    "storeys": {"choice": [1, 2, 3], "weights": [0.35, 0.5, 0.15]},
    "storey_height": {"normal": [2.8, 0.15], "within": [2.5, 3.3]},
    "roof_shape": {"choice": list(ROOF_SHAPES), "weights": [0.1, 0.1, 0.45, 0.2, 0.15]},
    "roof_pitch": {"uniform": [22.0, 48.0]},
    "overhang": {"uniform": [0.2, 0.6]},
    "embrasure": {"uniform": [0.05, 0.15]},
    "wall_thickness": {"uniform": [0.25, 0.4]},
    "garage": 0.35,
    "alcove": 0.25,
    "dormers": {"choice": [0, 1, 2, 3], "weights": [0.5, 0.2, 0.2, 0.1]},
    "dormer_width": {"uniform": [1.2, 2.0]},
    "dormer_height": {"uniform": [0.9, 1.4]},
    "dormer_gabled": 0.4,
    "chimney": 0.5,
    "roof_windows": {"choice": [0, 1, 2], "weights": [0.5, 0.3, 0.2]},
    "window_width": {"uniform": [0.8, 1.5]},
    "window_height": {"uniform": [1.0, 1.5]},
    "window_distance": {"uniform": [0.9, 1.8]},
    "door_width": {"uniform": [0.9, 1.2]},
    "door_height": {"uniform": [2.0, 2.2]},
    "year": {"uniform": [1900, 2024]},
    "use": "residential",
}
PRESETS: dict[str, dict[str, Any]] = {
    "detached": _DETACHED,
    "terraces": _DETACHED
    | {
        "length": 6.5,
        "width": 9.0,
        "storeys": {"choice": [2, 3], "weights": [0.7, 0.3]},
        "roof_shape": {"choice": ["gabled", "flat", "shed"], "weights": [0.7, 0.2, 0.1]},
        "overhang": 0.0,
        "garage": 0.0,
    },
    "apartments": _DETACHED
    | {
        "length": {"uniform": [24.0, 45.0]},
        "width": {"uniform": [11.0, 15.0]},
        "storeys": {"choice": [3, 4, 5, 6, 7, 8]},
        "roof_shape": {"choice": ["flat", "gabled", "hipped"], "weights": [0.6, 0.25, 0.15]},
        "roof_pitch": {"uniform": [15.0, 30.0]},
        "garage": 0.0,
        "dormers": {"choice": [0, 4, 6, 8]},
    },
    "wings": _DETACHED
    | {
        "footprint": {"choice": ["L", "T", "U", "courtyard"]},
        "length": {"uniform": [22.0, 27.0]},
        "width": {"uniform": [18.0, 21.0]},
        "storeys": {"choice": [1, 2, 3]},
        "roof_shape": {"choice": ["hipped", "gabled", "shed", "flat"], "weights": [0.4, 0.4, 0.1, 0.1]},
        "dormers": {"choice": [0, 2, 3, 4]},
    },
    "towers": _DETACHED
    | {
        "length": {"uniform": [20.0, 30.0]},
        "width": {"uniform": [18.0, 20.0]},
        "storeys": {"uniform": [10, 30]},
        "storey_height": {"uniform": [3.0, 4.0]},
        "roof_shape": "flat",
        "overhang": 0.0,
        "garage": 0.0,
        "alcove": 0.0,
        "dormers": 0,
        "chimney": 0.0,
        "use": "office",
    },
}


def make_rules(given: Mapping[str, Any], *, preset: str = "detached") -> dict[str, Distribution]:
    """Read rules.

    Parameters
    ----------
    given : mapping
        By the name of each rule: a number or a word; ``{"uniform": [least, greatest]}``; ``{"normal": [mean,
        deviation], "within": [least, greatest]}``; or ``{"choice": [...], "weights": [...]}``. Lengths are in
        metres, ``wing`` is the depth of the wings of a footprint that is no rectangle, ``roof_pitch`` is in
        degrees; ``garage``, ``alcove``, ``chimney`` and ``dormer_gabled`` are probabilities.
    preset : str
        The preset of `PRESETS` whose rules hold where none is given.

    Raises
    ------
    ValueError
        If a rule is not known, or gives a value out of its range: names rule, value and range.

    Examples
    --------
    >>> make_rules({"storeys": {"uniform": [2, 4]}})["storeys"].limits()
    (2.0, 4.0)
    """
    if preset not in PRESETS:
        raise ValueError(f"preset {preset!r}; one of {', '.join(PRESETS)}")
    unknown = sorted(given.keys() - PRESETS[preset].keys())
    if unknown:
        raise ValueError(f"rule {unknown[0]!r} is not known; there are {', '.join(sorted(PRESETS[preset]))}")
    return {name: _read_rule(name, rule) for name, rule in (PRESETS[preset] | dict(given)).items()}


def _read_rule(name: str, rule: Any) -> Distribution:
    try:
        found = _read_distribution(rule)
    except (TypeError, ValueError, KeyError) as error:
        raise ValueError(f"rule {name!r}: {rule!r} is no distribution ({error})") from error
    if name in WORDS:
        words = WORDS[name]
        for value in found.values:
            if found.kind not in ("constant", "choice") or not isinstance(value, str):
                raise ValueError(f"rule {name!r}: {value!r}, expected a word or a choice of words")
            if words is not None and value not in words:
                raise ValueError(f"rule {name!r}: {value!r}; one of {', '.join(words)}")
        return found
    if any(isinstance(value, (str, bool)) for value in found.values):
        raise ValueError(f"rule {name!r}: {rule!r}, expected numbers")
    (low, high), (least, most) = found.limits(), SIZES[name]
    if not least <= low <= high <= most:
        raise ValueError(f"rule {name!r}: gives {low:g} to {high:g}, expected {least:g} to {most:g}")
    return found


def _read_distribution(rule: Any) -> Distribution:
    if not isinstance(rule, Mapping):
        return Distribution("constant", (rule if isinstance(rule, str) else _number(rule),))
    keys = set(rule)
    if keys == {"uniform"}:
        return Distribution("uniform", _limits(rule["uniform"]))
    if keys == {"normal", "within"}:
        mean, sigma = map(_number, rule["normal"])
        low, high = _limits(rule["within"])
        if sigma <= 0:
            raise ValueError(f"deviation {sigma:g}, expected more than 0")
        return Distribution("normal", (mean, sigma, low, high))
    if keys <= {"choice", "weights"} and "choice" in keys:
        values = [value if isinstance(value, str) else _number(value) for value in rule["choice"]]
        return Distribution("choice", tuple(values), _cumulate(rule.get("weights"), len(values)))
    raise ValueError("expected uniform, normal and within, or choice and weights")


def _limits(values: Sequence[Any]) -> tuple[float, float]:
    low, high = map(_number, values)
    if low > high:
        raise ValueError(f"{low:g} to {high:g}, the least comes first")
    return low, high


def _cumulate(weights: Sequence[Any] | None, n: int) -> tuple[float, ...]:
    numbers = np.array([1.0] * n if weights is None else [_number(weight) for weight in weights])
    if len(numbers) != n or not n or (numbers < 0).any() or not numbers.sum() > 0:
        raise ValueError(f"{len(numbers)} weights for {n} choices, expected as many, not negative, not all 0")
    total = np.cumsum(numbers) / numbers.sum()
    total[total >= total[-1]] = 1.0
    return tuple(total.tolist())


def _number(value: Any) -> float:
    if isinstance(value, (bool, str)) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no number")
    return float(value)
