"""The plane keeps angles, its scale and convergence are the derivatives of its coordinates, and distortion is small."""

from __future__ import annotations

import numpy as np
import pytest

from gsisio_jax.examples.flight import KNOT, PLANE
from gsisio_jax.examples.projection import ObliqueMercator, conformal_latitude

LATITUDE, LONGITUDE = (x.ravel() for x in np.meshgrid(np.linspace(38.0, 60.0, 12), np.linspace(10.0, 34.0, 12)))


def _metres_per_degree(latitude):
    """Meridian and parallel of WGS84 [m/degree], from the radii of curvature."""
    a, f = 6378137.0, 1.0 / 298.257223563
    e2, phi = f * (2.0 - f), np.radians(latitude)
    root = 1.0 - e2 * np.sin(phi) ** 2
    return np.radians(a * (1.0 - e2) / root**1.5), np.radians(a * np.cos(phi) / root**0.5)


def _derivatives():
    step = 1e-5
    north = [PLANE(LATITUDE + sign * step, LONGITUDE) for sign in (1, -1)]
    east = [PLANE(LATITUDE, LONGITUDE + sign * step) for sign in (1, -1)]
    per_meridian, per_parallel = _metres_per_degree(LATITUDE)
    return tuple(
        np.stack([a.east - b.east, a.north - b.north]) / (2.0 * step * length)
        for (a, b), length in ((north, per_meridian), (east, per_parallel))
    )


def test_plane_is_conformal_with_the_stated_scale_and_convergence():
    point = PLANE(LATITUDE, LONGITUDE)
    north, east = _derivatives()
    np.testing.assert_allclose(np.hypot(*north), point.scale, rtol=1e-8)
    np.testing.assert_allclose(np.hypot(*east), point.scale, rtol=1e-8)
    # East is a quarter turn clockwise from north: no reflection, no shear.
    np.testing.assert_allclose(east, np.stack([north[1], -north[0]]), atol=1e-8)
    np.testing.assert_allclose(np.arctan2(north[0], north[1]), point.convergence, atol=1e-8)


def test_velocity_is_the_derivative_of_the_position():
    latitude, longitude, speed, track = 50.0, 20.0, 450.0 * KNOT, 331.0
    per_meridian, per_parallel = _metres_per_degree(latitude)
    direction, step = np.radians(track), 1e-3
    ends = [
        PLANE(
            np.array([latitude + sign * step * speed * np.cos(direction) / per_meridian]),
            np.array([longitude + sign * step * speed * np.sin(direction) / per_parallel]),
        )
        for sign in (0.5, -0.5)
    ]
    east, north = PLANE.velocity(
        PLANE(np.array([latitude]), np.array([longitude])), np.array([speed]), np.array([track])
    )
    np.testing.assert_allclose(east, (ends[0].east - ends[1].east) / step, rtol=1e-6)
    np.testing.assert_allclose(north, (ends[0].north - ends[1].north) / step, rtol=1e-6)


def test_scale_is_one_within_five_ten_thousandths_on_the_flight(table):
    point = PLANE(table.latitude_deg.to_numpy(), table.longitude_deg.to_numpy())
    assert np.nanmax(np.abs(point.scale - 1.0)) < 5e-4


def test_speed_bound_covers_the_scale_430_km_beside_the_line(config):
    line = ObliqueMercator((41.4, 28.8), (57.0, 15.9))
    along = np.linspace(-1.0e6, 1.0e6, 41)
    beside = np.array([-4.3e5, 4.3e5])
    # Points at that distance: walk from the line along the oblique meridian on the conformal sphere.
    angle, across = (x.ravel() / line._radius for x in np.meshgrid(along, beside))
    unit = np.cos(across) * (np.cos(angle) * line._middle[:, None] + np.sin(angle) * line._along[:, None])
    unit += np.sin(across) * line._pole[:, None]
    target = np.arcsin(unit[2])
    latitude = target
    for _ in range(20):
        latitude = latitude + target - conformal_latitude(latitude)
    point = line(np.degrees(latitude), np.degrees(np.arctan2(unit[1], unit[0])))
    assert 350.0 * point.scale.max() <= config["system"]["arguments"]["speed_bound"]


def test_origin_and_missing_values():
    point = PLANE(np.array([np.nan, 50.0]), np.array([20.0, np.nan]))
    assert np.isnan(point.east).all()
    origin = PLANE(*map(np.asarray, PLANE._origin()))
    assert np.hypot(origin.east, origin.north) < 1e-3
    assert float(origin.scale) == pytest.approx(1.0, abs=1e-12)
    assert float(origin.convergence) == pytest.approx(0.0, abs=1e-12)


def test_a_line_needs_two_points():
    with pytest.raises(ValueError, match="great circle"):
        ObliqueMercator((50.0, 10.0), (50.0, 10.0))
