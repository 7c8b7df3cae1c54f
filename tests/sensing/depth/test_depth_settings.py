"""The settings of a depth sensor: what is refused, and the numbers that follow from them."""

import math
from pathlib import Path

import numpy as np
import pytest

from keepout.errors import KeepoutError
from keepout.mapping import Pinhole, SensorBounds
from keepout.sensing.depth import Boresight, DepthCamera, ErrorDraw, axes_towards

AHEAD = np.array([1.0, 0.0, 0.0])
BAD = {
    "a negative range error": (lambda: SensorBounds(range_error=-0.01), ("range_error", "-0.01")),
    "a negative position error": (lambda: SensorBounds(position_error=-1.0), ("position_error", "-1.0")),
    "an attitude error that is not a number": (
        lambda: SensorBounds(attitude_error=math.nan),
        ("attitude_error", "nan"),
    ),
    "a field of view of 180 degrees": (lambda: Pinhole(160, 120, math.pi), ("horizontal_angle", "3.14")),
    "no pixels": (lambda: Pinhole(0, 120, 1.0), ("width", "0")),
    "greatest below least": (lambda: SensorBounds(least_range=5.0, greatest_range=4.0), ("greatest_range", "4", "5")),
    "no rays": (lambda: SensorBounds(rays_across=0), ("rays_across", "0")),
    "a width that is of no use": (
        lambda: DepthCamera(
            Pinhole(20, 20, 2.0), SensorBounds(surely_returned_width=0.01, rays_across=3, least_range=0.3)
        ),
        ("surely_returned_width", "0.01", "0.0963", "0.0311", "0.3"),
    ),
    "a dropout above 1": (lambda: DepthCamera(dropout=1.5), ("dropout", "1.5", "0 to 1")),
    "a grazing angle above 90 degrees": (lambda: DepthCamera(grazing_angle=2.0), ("grazing_angle", "2")),
    "no period": (lambda: DepthCamera(period=0.0), ("period", "0 s")),
    "a negative latency": (lambda: DepthCamera(latency=-1.0), ("latency", "-1 s")),
    "a mounting that is nowhere": (lambda: DepthCamera(mounting=(math.inf, 0.0, 0.0)), ("mounting", "inf")),
    "errors of an unknown size": (lambda: ErrorDraw("gaussian"), ("size", "gaussian", "adversarial")),
    "an unknown assumption": (lambda: ErrorDraw("random", "everything"), ("broken", "everything", "mixed")),
    "a rate of zero": (
        lambda: Boresight.at_rest(AHEAD, greatest_rate=0.0, greatest_acceleration=1.0),
        ("greatest_rate", "0 rad/s"),
    ),
    "an acceleration that is not a number": (
        lambda: Boresight.at_rest(AHEAD, greatest_rate=1.0, greatest_acceleration=math.nan),
        ("greatest_acceleration", "nan"),
    ),
    "a direction of zero": (lambda: axes_towards(np.zeros(3), AHEAD), ("direction", "not zero")),
    "a period of zero": (
        lambda: Boresight.at_rest(AHEAD, greatest_rate=1.0, greatest_acceleration=1.0).step(AHEAD, 0.0),
        ("period", "0 s"),
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_settings_are_refused_in_one_line_with_their_numbers(what):
    make, words = BAD[what]
    with pytest.raises(KeepoutError) as refusal:
        make()
    assert "\n" not in str(refusal.value)
    for word in words:
        assert word in str(refusal.value)


def test_the_pitch_of_rays_is_the_distance_of_neighbours_in_the_middle():
    sensor = DepthCamera()
    rays = sensor.camera.directions(sensor.bounds.rays_across)
    row, column = (size // 2 for size in rays.shape[:2])
    apart = np.arccos(rays[row, column] @ rays[row, column + 1])
    assert abs(apart / sensor.ray_pitch - 1.0) < 1e-4
    assert abs(sensor.bounds.usable_range(sensor.camera) - sensor.bounds.surely_returned_width / (2.0 * apart)) < 1e-2


def test_the_sensor_sits_where_it_is_mounted():
    sensor = DepthCamera(mounting=(0.1, 0.2, 0.3))
    axes = axes_towards(AHEAD, np.array([0.0, 0.0, 1.0]))
    # x of the image is to the right, -y of the map; y is down, -z of the map; z is ahead, x of the map.
    np.testing.assert_allclose(sensor.sensor_position(np.array([5.0, 0.0, 0.0]), axes), [5.3, -0.1, -0.2])


def test_the_page_says_the_pitch_that_the_default_settings_have():
    page = (Path(__file__).parents[3] / "docs" / "depth-sensor.md").read_text(encoding="utf-8")
    # From the angle of view and the number of rays: the tangent of half the angle is half the rays' pitches.
    pitch = math.tan(math.radians(30.0)) / (160 * 5 / 2)
    assert DepthCamera().ray_pitch == pytest.approx(pitch)
    assert f"{1e3 * pitch:.3f} mrad with the default settings, which is {1e4 * pitch:.1f} mm at 10 m" in page
    assert f"{0.03 / (2.0 * pitch):.1f} m for 0.03 m" in page
