"""Conversion between the conductivity and the salinity of seawater, by temperature and pressure: the practical salinity scale
of 1978.

Source: Fofonoff and Millard, "Algorithms for computation of fundamental properties of seawater", UNESCO technical papers in
marine science 44 (1983), section 1; the tests contain its check values. Valid for salinities of 2 to 42. Temperatures are in
ITS-90 and are converted to IPTS-68, in which the scale is defined (t68 = 1.00024 t90).
"""

from __future__ import annotations

import math

from fieldtwin.gateway.core.errors import Bug

C_35_15_0 = 4.2914
"""Conductivity in S/m of seawater of salinity 35 at 15 degC (IPTS-68) and zero pressure."""

T68_PER_T90 = 1.00024

_A = (0.0080, -0.1692, 25.3851, 14.0941, -7.0261, 2.7081)
_B = (0.0005, -0.0056, -0.0066, -0.0375, 0.0636, -0.0144)
_K = 0.0162
_RT35 = (0.6766097, 2.00564e-2, 1.104259e-4, -6.9698e-7, 1.0031e-9)
_D = (3.426e-2, 4.464e-4, 4.215e-1, -3.107e-3)
_E = (2.070e-5, -6.370e-10, 3.989e-15)

_MAX_STEPS = 20


def salinity(conductivity: float, temperature: float, pressure: float) -> float:
    """Return the practical salinity from conductivity in S/m, temperature in degC (ITS-90) and pressure in dbar."""
    t68 = temperature * T68_PER_T90
    ratio = conductivity / C_35_15_0
    numerator, fixed, slope = _pressure_terms(t68, pressure)
    rp = 1.0 + numerator / (fixed + slope * ratio)
    return _salinity_of(math.sqrt(ratio / (rp * _polynomial(_RT35, t68))), t68)


def conductivity(salinity_psu: float, temperature: float, pressure: float) -> float:
    """Return the conductivity in S/m from practical salinity, temperature in degC (ITS-90) and pressure in dbar."""
    t68 = temperature * T68_PER_T90
    root = _root_of(salinity_psu, t68)
    at_surface = root * root * _polynomial(_RT35, t68)
    # ratio = at_surface * (1 + numerator / (fixed + slope * ratio)), a quadratic in ratio
    numerator, fixed, slope = _pressure_terms(t68, pressure)
    half = (fixed - slope * at_surface) / 2
    ratio = (math.sqrt(half * half + slope * at_surface * (fixed + numerator)) - half) / slope
    return ratio * C_35_15_0


def _pressure_terms(t68: float, pressure: float) -> tuple[float, float, float]:
    """Return the terms of the pressure correction: the numerator, and the constant and the slope of the denominator."""
    d1, d2, d3, d4 = _D
    numerator = pressure * _polynomial(_E, pressure)
    return numerator, 1.0 + d1 * t68 + d2 * t68 * t68, d3 + d4 * t68


def _salinity_of(root: float, t68: float) -> float:
    """Return the salinity from the square root of the conductivity ratio at the surface."""
    warmer = t68 - 15.0
    return _polynomial(_A, root) + warmer / (1.0 + _K * warmer) * _polynomial(_B, root)


def _root_of(wanted: float, t68: float) -> float:
    """Return the inverse of `_salinity_of`, by Newton's method with the exact derivative."""
    if not 2.0 <= wanted <= 42.0:
        raise Bug("outside the practical salinity scale", expected="2 to 42", got=str(wanted))
    warmer = t68 - 15.0
    share = warmer / (1.0 + _K * warmer)
    slope = [i * (a + share * b) for i, (a, b) in enumerate(zip(_A, _B, strict=True))][1:]
    root = math.sqrt(wanted / 35.0)
    for _ in range(_MAX_STEPS):
        step = (_salinity_of(root, t68) - wanted) / _polynomial(tuple(slope), root)
        root -= step
        if abs(step) < 1e-13:
            return root
    raise Bug("the salinity found no root", got=f"{wanted} at {t68} degC")


def _polynomial(coefficients: tuple[float, ...], x: float) -> float:
    total = 0.0
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total
