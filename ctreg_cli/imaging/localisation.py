"""Centres of spots at the statistical bound, with covariances that own up to streaks.

Profiles are fitted to all windows (:mod:`.profiles`), and what is known of their centres is measured there
(:mod:`.law`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.imaging.blob import Blobs
from ctreg_cli.imaging.law import centre_columns, centre_law, structure_near
from ctreg_cli.imaging.profiles import fit_profiles, misfit_of

#: a smooth kernel's noise makes peaks of the height of its whole sd, not of what differs from pixel to pixel; but part
#: of what seems to be such noise is structure, which hides no rod
SMOOTH_NOISE_SHARE = 0.7
#: of a mask, whose pixels only say "in" or "out", the variance of the centre of gravity times the radius, px³: each of
#: the 2πr pixels on its rim is in by any share between none and all (1/12), and weighs r²/2 over the squared area
MASK_VARIANCE = 1.0 / (12.0 * np.pi)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Centres:
    """Fitted centres of ``k`` blobs, image coordinates."""

    #: (k, 2) px
    uv_px: FloatArray
    #: (k, 2, 2) px²
    covariance_px: FloatArray
    #: (k,) sd of the noise that a spot must stand out of, stored units
    noise: FloatArray


def fit_centres(blobs: Blobs, ceiling: float) -> Centres:
    """Fit the profile to every blob.

    Where a fit runs away (more than the blob's own size from its centre of gravity), the centre of gravity is returned
    with a covariance of the blob's size: known badly, and said so.

    Args:
        blobs: windows of one radius.
        ceiling: value at which the image is cut off; pixels of that value are taken as "at least so bright".
    """
    fitted = fit_profiles(blobs, ceiling)
    law = centre_law(fitted, centre_columns(fitted.normal), blobs.radius)
    covariance = law.covariance(structure_near(fitted, law.rough, blobs.radius), misfit_of(fitted.rows.by_spot))
    uv = fitted.centre.T
    away = ((uv - blobs.centre) ** 2).sum(axis=1)
    size = np.trace(blobs.moments, axis1=1, axis2=2)
    found = np.isfinite(uv).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)) & (away <= size)
    if not found.all():
        uv = np.where(found[:, None], uv, blobs.centre)
        covariance = np.where(found[:, None, None], covariance, blobs.moments)
    masks = np.flatnonzero(are_masks(blobs))
    if len(masks):
        uv, covariance = uv.copy(), covariance.copy()
        uv[masks] = blobs.centre[masks]
        covariance[masks] = (MASK_VARIANCE / np.sqrt(blobs.area[masks] / np.pi))[:, None, None] * np.eye(2)
    noise = np.maximum(law.rough, SMOOTH_NOISE_SHARE * law.smooth)
    return Centres(uv_px=blobs.middles + uv, covariance_px=covariance, noise=noise)


def are_masks(blobs: Blobs) -> BoolArray:
    """Which windows (k,) hold but two values, as a mask does: a profile fitted to these says nothing of its centre."""
    values = blobs.values.reshape(len(blobs), -1)
    least, most = np.nanmin(values, axis=1, keepdims=True), np.nanmax(values, axis=1, keepdims=True)
    return np.asarray(((values == least) | (values == most) | np.isnan(values)).all(axis=1))
