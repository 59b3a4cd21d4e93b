"""Remarks on an implausible camera: values that are unusual for cameras in cars."""

import math
from collections.abc import Sequence
from fractions import Fraction

from lanebev.camera.model import Camera
from lanebev.camera.parameters import centre_offset

_FIELD_OF_VIEW = (25.0, 130.0)  # degrees, horizontal, of cameras in cars with a pinhole model
_IMPOSSIBLE_VIEW = 170.0  # degrees, of focal lengths in mm
_RESCALED = (0.08, 0.02)  # sides: least offset of a principal point, most difference of that in x and y
_OFF_CENTRE = (0.2, 0.4)  # sides, more than a principal point is off the middle in x and y; skies are cut off
_MOST_TANGENTIAL = 0.025  # coefficient of a lens that is not doubted
_LIKE_RADIAL = 0.008  # coefficient, from which on a p1 much larger than p2 and k3 may be k3
_WIDE = 95.0  # degrees, from which on lenses distort
_MOST_EDGE_RATIO = 0.93  # an edge's distance from the centre by that of an ideal lens, for wide lenses
_MOST_PINCUSHION = 1.25  # the same ratio of any lens
_SAME_PIXELS = 0.05  # relative, by which a camera file may differ from the width of pixels over their height
_PLUMB_BOB = (-0.15, 0.02)  # most of k1, and of |k3| and |k4|, that are like plumb_bob's


def camera_remarks(camera: Camera, pixel_aspect: Fraction = Fraction(1)) -> list[str]:
    """Return remarks on the file, an implausible lens, or a wrong size of images, model or focal length.

    Args:
        camera: of the settings.
        pixel_aspect: width of a pixel over its height, as the video states it; 1 if it does not.
    """
    found = (
        camera.remark,
        lens_remark(camera),
        resized_remark(camera) or off_centre_remark(camera),
        model_remark(camera),
        view_remark(camera),
        pixel_remark(camera, pixel_aspect),
    )
    return [f"camera: {remark}" for remark in found if remark]


def field_of_view(camera: Camera) -> float:
    """Return the angle (degrees) between the left and the right edge; 180 if the lens has no rays there."""
    height, width = camera.image_size
    edges = camera.intrinsics.new_tensor([[0.0, 0.5 * (height - 1)], [width - 1.0, 0.5 * (height - 1)]])
    if not bool(camera.undistort_points(edges)[1].all()):
        return 180.0
    rays = camera.rays(edges)
    return math.degrees(sum(math.atan(abs(float(ray[0] / ray[2]))) for ray in rays))


def lens_remark(camera: Camera) -> str:
    """Return a remark on the number of pixels that the lens cannot image; else nothing."""
    share = camera.share_without_rays()
    return (
        f"{share:.2%} of the pixels cannot be undistorted by the lens; lanes there are left out"
        if share
        else ""
    )


def resized_remark(camera: Camera) -> str:
    """Return a remark on a principal point in the middle of images of another size; else nothing."""
    (height, width), matrix = camera.image_size, camera.intrinsics.flatten().tolist()
    least, most = _RESCALED
    offset = centre_offset(matrix, camera.image_size)
    words = f"the principal point {matrix[2]:.0f}, {matrix[5]:.0f} is in the middle of images of"
    if offset > least > centre_offset(matrix, (width, height)):
        return (
            f"{words} {height} x {width} px, not of {width} x {height}: are cx and cy, or the sides, swapped?"
        )
    if offset < least or abs(matrix[2] / width - matrix[5] / height) > most:
        return ""
    other = f"{2 * matrix[2] + 1:.0f} x {2 * matrix[5] + 1:.0f}"
    return (
        f"{words} {other} px, not of {width} x {height}: was it calibrated at another size? see Camera.scaled"
    )


def off_centre_remark(camera: Camera) -> str:
    """Return a remark on a principal point that is far from the middle of the images; else nothing."""
    (height, width), x, y = camera.image_size, *camera.intrinsics[:2, 2].tolist()
    across, down = _OFF_CENTRE
    if abs(x / width - 0.5) <= across and abs(y / height - 0.5) <= down:
        return ""
    return (
        f"the principal point {x:.0f}, {y:.0f} is far from the middle of the {width} x {height} px: is it in "
        "pixels, and are the images whole?"
    )


def pixel_remark(camera: Camera, pixel_aspect: Fraction) -> str:
    """Return a remark on focal lengths of pixels of another shape than the video's; else nothing.

    The focal lengths of a lens are equal in mm, so fy / fx in pixels is the width of a pixel over its height.
    """
    own, stated = float(camera.intrinsics[1, 1] / camera.intrinsics[0, 0]), float(pixel_aspect)
    if abs(own / stated - 1) <= _SAME_PIXELS:
        return ""
    words = f"fy / fx is {own:.2f}, of pixels {own:.2f} times as wide as high"
    if stated == 1.0:
        return f"{words}: were images squeezed, or is a focal length wrong?"
    return (
        f"{words}, but the video states {stated:.2f} times: is fx that of frames as players show them? "
        f"then divide it by {stated:.4g}"
    )


def model_remark(camera: Camera) -> str:
    """Return a remark on coefficients that are typical of another lens model; else nothing."""
    given = camera.distortion.tolist()
    if camera.model == "fisheye":
        below, least = _PLUMB_BOB
        if given[0] < below and max(map(abs, given[2:])) < least:
            return (
                f"distortion {_listed(given)} is like one of plumb_bob, not of a fisheye: is the model right?"
            )
        return ""
    if camera.model != "pinhole" or len(given) < 4:
        return ""
    angle, ratio, asked = field_of_view(camera), _edge_ratio(camera), "is the order k1 k2 p1 p2 k3?"
    if may_be_fisheye := not any(given[4:]) and 0.0 not in given[2:4]:
        asked = "are they k1 k2 k3 k4 of a fisheye? then model: fisheye is missing"
    p1, p2, k3 = given[2], given[3], given[4] if len(given) > 4 else 0.0
    all_five = len(given) > 4 and (k3 != 0.0 or p2 == 0.0)  # a calibration without k3 leaves it 0
    like_radial = all_five and abs(p1) > max(_LIKE_RADIAL, 4 * abs(p2), 4 * abs(k3))  # k1 k2 k3 p1 p2
    if like_radial or max(map(abs, given[2:4])) > _MOST_TANGENTIAL:
        return f"distortion {_listed(given)} has more tangential distortion than is usual; {asked}"
    if may_be_fisheye and angle > _WIDE and ratio > _MOST_EDGE_RATIO:
        return f"distortion {_listed(given)} hardly distorts, with {angle:.0f} degrees of view; {asked}"
    if ratio > _MOST_PINCUSHION:
        return (
            f"distortion {_listed(given)} moves the left edge {ratio:.1f} times as far from the centre, "
            "more than is usual: are sign and order of the coefficients right?"
        )
    return ""


def _edge_ratio(camera: Camera) -> float:
    """Return the left edge's distance from the centre, as a share of that of a lens without distortion.

    It is 0 if the lens has no ray there.
    """
    centre = camera.intrinsics[0, 2]
    edge = camera.intrinsics.new_tensor([[0.0, float(camera.intrinsics[1, 2])]])
    ideal, valid = camera.undistort_points(edge)
    return float(centre / (centre - ideal[0, 0])) if bool(valid.all()) else 0.0


def view_remark(camera: Camera) -> str:
    """Return a remark on a focal length that gives an implausible field of view; else nothing."""
    angle, (low, high) = field_of_view(camera), _FIELD_OF_VIEW
    if low <= angle <= high or angle == 180.0 or camera.model != "pinhole":  # 180: see share_without_rays
        return ""
    asked = "was it calibrated at another size?"
    if angle > _IMPOSSIBLE_VIEW:
        asked = "are the focal lengths in pixels?"
    return f"{angle:.0f} degrees of view across, where cameras on cars have {low:g} to {high:g}: {asked}"


def _listed(coefficients: Sequence[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in coefficients[:4])
