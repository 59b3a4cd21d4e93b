"""Settings of the commands. Nothing here imports anything heavy.

``run`` and ``export`` have the settings of these commands, made of the ``options`` that ``arguments`` and
a YAML ``file`` give.
"""

from lanebev.app.config.run import (
    BACKENDS,
    CALIBRATORS,
    FOV_FOCAL_STD,
    PRECISIONS,
    NetworkSettings,
    RunConfig,
    rate_as_fraction,
)

__all__ = [
    "BACKENDS",
    "CALIBRATORS",
    "FOV_FOCAL_STD",
    "PRECISIONS",
    "NetworkSettings",
    "RunConfig",
    "rate_as_fraction",
]
