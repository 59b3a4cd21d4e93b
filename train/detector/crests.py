"""Distance of the road of drives from its tangent plane: ``python -m train.detector.crests FOLDER``.

The true pose is that over the tangent plane under the camera. Prints, by distance ahead, the elevation of the
road over this plane, the error of a position that is read off the plane, and how the pitch of the online
calibration follows the elevation.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lanebev.render.scene.road.alignment import elevation_at
from train.commands import command_parser, one_line_errors
from train.detector.drives import GRID, NOMINAL, WARM_UP, ShakingDrive
from train.detector.frames import DriveFrames

AHEAD = (10.0, 20.0, 30.0, 40.0)  # m


def elevations(path: Path, frames: int, fps: float) -> Tensor:
    """Compute the elevations (N, 4) m, at AHEAD, of the frames of a drive's file after the warm-up."""
    drive = ShakingDrive(int(path.stem), image_size=(16, 32), num_frames=frames, fps=fps)
    arcs = [drive.speed * float(drive.times[index]) for index in range(WARM_UP, frames)]
    z = torch.tensor([AHEAD])
    return torch.cat([elevation_at(drive.course.alignment(arc), z) for arc in arcs])


def summary(elevation: Tensor, pitch_error: Tensor) -> list[list[float]]:
    """Compute a row of each distance.

    Args:
        elevation: (N, 4) m at AHEAD.
        pitch_error: (N,) rad.

    Returns:
        rows of RMS elevation, m; RMS error of a position on the plane, m; RMS angle of the elevation,
        degrees; its correlation with the error of pitch; slope of the error's regression on the angle.
    """
    rows = []
    for ahead, each in zip(AHEAD, elevation.double().T, strict=True):
        angle, error = (each / ahead).numpy(), pitch_error.double().numpy()
        rms = float(each.square().mean().sqrt())
        degrees = float(np.degrees(rms / ahead))
        regression = float(angle @ error / (angle @ angle))
        correlation = float(np.corrcoef(angle, error)[0, 1])
        rows.append([rms, rms * ahead / NOMINAL[3], degrees, correlation, regression])
    return rows


@one_line_errors()
def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    parser = command_parser(__doc__)
    parser.add_argument("drives", type=Path, help="folder of files of train.detector.drives")
    parser.add_argument("--fps", type=float, default=10.0, help="frames per second of the drives")
    given = parser.parse_args(args)
    data = DriveFrames(given.drives, GRID)
    paths = sorted(given.drives.glob("*.npz"))
    elevation = torch.cat([
        elevations(path, len(record.ends), given.fps)
        for path, record in zip(paths, data.records, strict=True)
    ])  # fmt: skip
    error = (data.frames.online - data.frames.extrinsics)[:, 0]
    print("| ahead | elevation | error of position | angle | correlation | regression |")
    print("|---|---|---|---|---|---|")
    for ahead, row in zip(AHEAD, summary(elevation, error), strict=True):
        print(
            f"| {ahead:g} m | {row[0]:.3f} m | {row[1]:.2f} m | {row[2]:.3f}° | {row[3]:.2f} | {row[4]:.2f} |"
        )


if __name__ == "__main__":
    main()
