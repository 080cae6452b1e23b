"""A conformal plane along a great circle, for flights of a few thousand kilometres.

Two conformal maps, one after the other: ellipsoid -> sphere (conformal latitude, Gauss), sphere -> plane (Mercator
whose equator is the great circle through two given points). Both keep angles, so a velocity given as ground speed and
true track becomes a plane velocity by one scale factor and one rotation (the meridian convergence). Along a great
circle of 2,000 km the scale differs from 1 by half a thousandth, 300 km beside it by one and a half. The exact scale
is used in any case; the only thing left out is the height above the ellipsoid.

Source: Snyder, Map Projections: A Working Manual (USGS 1395), eq. 3-1 (conformal latitude) and section 9 (oblique
Mercator, sphere).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WGS84_RADIUS = 6378137.0
"""Equatorial radius [m]."""
WGS84_ECCENTRICITY = 0.0818191908426215
"""First eccentricity [1]."""


def conformal_latitude(latitude: np.ndarray) -> np.ndarray:
    """Latitude [rad] on the sphere that the WGS84 ellipsoid is mapped to without changing angles.

    Source: Snyder, eq. 3-1, written with the inverse Gudermann function: atanh(sin chi) is the isometric latitude.
    """
    sine = np.sin(latitude)
    isometric = np.arctanh(sine) - WGS84_ECCENTRICITY * np.arctanh(WGS84_ECCENTRICITY * sine)
    return np.arcsin(np.tanh(isometric))


@dataclass(frozen=True)
class PlanePoint:
    """Where a point lies in the plane and how the plane is turned and stretched there; arrays of one shape.

    Attributes:
        east, north: plane coordinates [m].
        scale: plane length over length on the ellipsoid [1].
        convergence: direction of true north in the plane, clockwise from plane north [rad].
    """

    east: np.ndarray
    north: np.ndarray
    scale: np.ndarray
    convergence: np.ndarray


class ObliqueMercator:
    """Conformal plane whose line of smallest distortion is the great circle through two points.

    The plane's origin is the middle of the two points; there plane north is true north and, on the great circle, the
    scale is 1.

    Args:
        start: latitude and longitude [deg] of one point of the line.
        end: latitude and longitude [deg] of another one, neither equal nor opposite.

    Raises:
        ValueError: the two points do not fix a great circle.
    """

    def __init__(self, start: tuple[float, float], end: tuple[float, float]):
        first, last = (_unit(conformal_latitude(np.radians(phi)), np.radians(lam)) for phi, lam in (start, end))
        pole = np.cross(first, last)
        if np.linalg.norm(pole) < 1e-9:
            raise ValueError(
                f"ObliqueMercator: `start` {start} and `end` {end} are equal or opposite; give two points that fix "
                "a great circle"
            )
        self._pole = pole / np.linalg.norm(pole)
        middle = first + last
        self._middle = middle / np.linalg.norm(middle)
        self._along = np.cross(self._pole, self._middle)
        # Make the scale 1 at the origin, and turn the axes so that plane north is true north there.
        self._radius, self._turn = 1.0, 0.0
        latitude, longitude = self._origin()
        here = self(latitude, longitude)
        self._radius, self._turn = 1.0 / float(here.scale), float(here.convergence)

    def __call__(self, latitude: np.ndarray, longitude: np.ndarray) -> PlanePoint:
        """Project geodetic coordinates.

        Args:
            latitude, longitude: WGS84 [deg], arrays of one shape; NaN gives NaN.

        Returns:
            Coordinates [m], scale and convergence [rad] at each point.
        """
        phi, lam = np.radians(latitude), np.radians(longitude)
        chi = conformal_latitude(phi)
        point = _unit(chi, lam)
        across = point @ self._pole  # sine of the oblique latitude
        cosine = np.sqrt(1.0 - across**2)
        x = np.arctan2(point @ self._along, point @ self._middle)
        y = np.arctanh(across)
        # The direction of true north, measured along the oblique parallel and the oblique meridian.
        true_north = np.stack([-np.sin(chi) * np.cos(lam), -np.sin(chi) * np.sin(lam), np.cos(chi)], -1)
        parallel = np.cross(self._pole, point) / cosine[..., None]
        convergence = np.arctan2(np.sum(true_north * parallel, -1), true_north @ self._pole / cosine) - self._turn
        normal_radius = WGS84_RADIUS / np.sqrt(1.0 - (WGS84_ECCENTRICITY * np.sin(phi)) ** 2)
        scale = self._radius * np.cos(chi) / (normal_radius * np.cos(phi)) / cosine
        cos_turn, sin_turn = np.cos(self._turn), np.sin(self._turn)
        return PlanePoint(
            east=self._radius * (cos_turn * x - sin_turn * y),
            north=self._radius * (sin_turn * x + cos_turn * y),
            scale=scale,
            convergence=np.arctan2(np.sin(convergence), np.cos(convergence)),
        )

    def velocity(self, point: PlanePoint, ground_speed: np.ndarray, track: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Plane velocity (east, north) [m/s] of a ground speed [m/s] along a true track [deg] at a projected point."""
        speed, direction = point.scale * ground_speed, np.radians(track) + point.convergence
        return speed * np.sin(direction), speed * np.cos(direction)

    def _origin(self) -> tuple[np.ndarray, np.ndarray]:
        """Geodetic coordinates [deg] of the origin: invert the conformal latitude by fixed point (error e^2 a turn)."""
        chi = np.arcsin(self._middle[2])
        phi = chi
        for _ in range(12):
            phi = phi + chi - conformal_latitude(phi)
        return np.degrees(phi), np.degrees(np.arctan2(self._middle[1], self._middle[0]))


def _unit(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """Unit vector of spherical coordinates [rad], last axis of length 3."""
    return np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=-1
    )
