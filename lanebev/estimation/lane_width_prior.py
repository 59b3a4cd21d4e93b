"""The lane width that an estimate takes, and its standard deviation. Imports nothing heavy."""

LANE_WIDTH, LANE_WIDTH_STD = 3.7, 0.2
"""Mean and standard deviation (m) of an unknown lane width: most main roads have lanes of 3.25 to 3.75 m."""
_MOST_STD = 2.0  # m


def lane_width_prior(width: float | None, std: float | None) -> tuple[float, float]:
    """Return lane width and its standard deviation, m: a given width is exact unless ``std`` is given too.

    Args:
        width: m; None is an unknown one, ``LANE_WIDTH`` with a standard deviation of ``LANE_WIDTH_STD``.
        std: m; None is 0 with a width and ``LANE_WIDTH_STD`` without.
    """
    mean, usual = (LANE_WIDTH, LANE_WIDTH_STD) if width is None else (float(width), 0.0)
    return mean, usual if std is None else float(std)


def check_lane_width_prior(width: float, std: float, names: tuple[str, str]) -> None:
    """Raise unless a lane width and its standard deviation, m, are ones that a road may have.

    Args:
        width: m.
        std: m.
        names: what the two are called in the message.
    """
    if not 0.0 <= std <= _MOST_STD:
        raise ValueError(f"{names[1]}: expected 0 to {_MOST_STD:g} m, got {std:g}")
    if not 1.0 < width < 10.0:
        raise ValueError(f"{names[0]}: expected 1 to 10 m, got {width:g}")
