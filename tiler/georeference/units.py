"""Units of length that clouds and CRSs have."""

# By EPSG code.
METRES = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937, 9005: 0.3047972654, 9036: 1000.0, 9096: 0.9144}
UNITS = {"m": 1.0, "ft": 0.3048, "ftUS": 1200 / 3937}  # that --height-unit takes
_NAMES = {1.0: "metres", 0.3048: "feet", 1200 / 3937: "US survey feet"}
_SAME = 1e-9  # relative; what registers and files write of one unit differs by less


def exact_unit(unit: float) -> float:
    """Give a unit (m) as its definition has it, where it is one of `METRES`: registers write ten digits or more.

    Examples
    --------
    >>> exact_unit(0.304800609601219) == 1200 / 3937, exact_unit(2.0)
    (True, 2.0)
    """
    return next((known for known in METRES.values() if same_unit(unit, known)), unit)


def same_unit(one: float, other: float) -> bool:
    """Whether two units (m) are one.

    Examples
    --------
    >>> same_unit(0.3048, 1200 / 3937)
    False
    """
    return abs(one / other - 1) < _SAME


def unit_name(unit: float) -> str:
    """Name a unit by its metres.

    Examples
    --------
    >>> unit_name(0.3048), unit_name(2.0)
    ('feet', 'units of 2 m')
    """
    return next((name for size, name in _NAMES.items() if same_unit(unit, size)), f"units of {unit:.9g} m")
