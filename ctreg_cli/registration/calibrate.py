"""Pixel scales from slices of a known frame: labels unknown, scales unknown (Doignon et al. 2008, §2, eq. 6).

One slice bounds a scale to about a percent, so all slices are solved jointly: shared s_x and s_y, one pose each, and
where the frame has a ``tolerance``, the rods' true lines. Labels come from the matcher, which wants a scale:
DICOM's PixelSpacing is tried first, and where there is none or it does not fit, a logarithmic grid over every scale a
scanner has.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.checks import demand
from ctreg_cli.errors import CalibrationError
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.adjustment import ScanSpots, adjust
from ctreg_cli.registration.matching import search
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.refine import Observations, refine_scales
from ctreg_cli.registration.register import BAD_FIT_P, INFLATE_P, make_scene, register
from ctreg_cli.registration.result import Registration
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

#: scales a scanner may have, mm per pixel
SCALE_RANGE = (0.1, 2.0)
#: step of the search over scales; the extra spot noise allows for half of it
_GRID_STEP = 1.04
#: pixels need not be square: aspect ratios s_x / s_y tried, the likeliest first
_ASPECTS = (1.0, 1 / 1.08, 1.08, 1 / 1.17, 1.17, 1 / 1.26, 1.26)
#: relative scale error allowed for while labels are looked for
_SLACK_NOMINAL, _SLACK_GRID, _SLACK_FITTED = 0.01, 0.025, 0.004
#: matched spots below which one slice says nothing of two scales and a pose
_LEAST_SPOTS = 5
#: ln odds of a match at a grid scale that make it worth a fit
_START_LOG_ODDS = 4.0
#: starting scales that are fitted, the best first
_MOST_STARTS = 3
_ROUNDS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Estimated mm per pixel along u and v, with standard deviations, and what they rest on."""

    scale: Scale
    #: standard deviations of s_x and s_y, mm/px
    sd_s_x: float
    sd_s_y: float
    n_slices: int
    n_spots: int
    #: root mean square residual over both coordinates of every matched spot, px
    rms_px: float
    #: DICOM PixelSpacing, the same in every slice used, or None
    nominal: Scale | None
    model_name: str
    model_sha256: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationRun:
    """A calibration and the poses that came with it."""

    calibration: Calibration
    #: place in the input of each slice used
    used: tuple[int, ...]
    #: (b, 4, 4) poses of the slices used, and (b, 6, 6) their covariances with the uncertain scale in them
    T_slice_model: FloatArray
    covariance: FloatArray
    #: why each slice that was not used was not, by place
    left_out: dict[int, str]
    #: factor by which the standard deviations were widened because the spots were worse than believed
    inflation: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Labelled:
    """A slice whose spots have rods."""

    place: int
    T: FloatArray
    #: (n,) spot of each rod, −1 for none
    spot_of_rod: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    log_odds: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    """Shared scales and one pose a slice; covariances as if the spots' own were true."""

    #: (2,) and (2, 2)
    mm_per_px: FloatArray
    covariance: FloatArray
    #: (b, 4, 4) and (b, 6, 6), with the uncertain scale in them
    T: FloatArray
    pose_covariance: FloatArray
    #: (b, n) and (b, n, 2) measured minus predicted
    matched: BoolArray
    residual_px: FloatArray
    chi2: float
    degrees_of_freedom: int


def calibrate(
    slices: Iterable[SpotSlice], model: RodModel, *, options: RegistrationOptions | None = None
) -> CalibrationRun:
    """Estimate s_x and s_y with standard deviations from one or many slices.

    Args:
        slices: the spots of each slice; their own scale, where they have one, only narrows the search.
        model: the rods.
        options: see :class:`RegistrationOptions`.

    Raises:
        CalibrationError: no scale between 0.1 and 2 mm/px explains the spots; the sentence says what was missing.
        InputError: the slices are images, or something else than spots.
    """
    options = options or RegistrationOptions()
    slices = list(slices)
    for place, item in enumerate(slices):
        what = type(item).__name__
        demand(isinstance(item, SpotSlice), f"slices[{place}]", what, "spots: ctreg_cli.segment(slices, options)")
    usable = [place for place, item in enumerate(slices) if len(item.spots) >= _LEAST_SPOTS]
    if not usable:
        raise CalibrationError(
            f"no slice has {_LEAST_SPOTS} spots or more: two scales and a pose cannot be told from fewer; "
            "look at the spots with: ctreg segment --overlay DIR"
        )
    nominal = _common_nominal(slices, usable)
    fit: _Fit | None = None
    labelled: list[_Labelled] = []
    if nominal is not None:
        labelled, fit = _fit_from(slices, usable, model, nominal, _SLACK_NOMINAL, options)
    if fit is None:
        labelled, fit = _search_scales(slices, usable, model, options)
    if fit is None:
        raise CalibrationError(
            f"no scale between {SCALE_RANGE[0]} and {SCALE_RANGE[1]} mm/px explains the spots of {model.name} "
            "in any slice; check the frame file, and the spots with: ctreg segment --overlay DIR"
        )
    return _report(slices, model, nominal, labelled, fit)


def _common_nominal(slices: Sequence[SpotSlice], usable: list[int]) -> Scale | None:
    scales = {(s.s_x, s.s_y) for s in (slices[place].info.scale for place in usable) if s is not None}
    if len(scales) > 1:
        raise CalibrationError(
            f"the slices have {len(scales)} different PixelSpacings; calibrate one reconstruction at a time (--series)"
        )
    for s_x, s_y in scales:
        return Scale(s_x=s_x, s_y=s_y)
    return None


def _fit_from(
    slices: Sequence[SpotSlice],
    usable: list[int],
    model: RodModel,
    start: Scale,
    slack: float,
    options: RegistrationOptions,
) -> tuple[list[_Labelled], _Fit | None]:
    """Label at a scale, fit, label again at the fitted one, until the labels stay."""
    scale, labelled, fit = start, list[_Labelled](), None
    before: object = None
    for _ in range(_ROUNDS):
        labelled = [x for x in (_label(slices[p], p, model, scale, slack, options) for p in usable) if x is not None]
        if not labelled:
            return [], None
        fit = _fit(slices, labelled, model, scale)
        if not _believable(fit):
            return [], None
        scale = Scale(s_x=float(fit.mm_per_px[0]), s_y=float(fit.mm_per_px[1]))
        now = [(x.place, x.spot_of_rod.tolist()) for x in labelled]
        if now == before:
            break
        before, slack = now, _SLACK_FITTED
    return labelled, fit


def _believable(fit: _Fit) -> bool:
    low, high = SCALE_RANGE
    variance = fit.covariance.diagonal()  # rounding may make those of spots that say next to nothing negative
    return bool(
        np.isfinite(fit.chi2)
        and fit.degrees_of_freedom > 0
        and chdtrc(fit.degrees_of_freedom, fit.chi2) > BAD_FIT_P**2
        and (fit.mm_per_px > 0.9 * low).all()
        and (fit.mm_per_px < 1.1 * high).all()
        and ((variance > 0) & (variance < (0.2 * fit.mm_per_px) ** 2)).all()
    )


def _label(
    item: SpotSlice, place: int, model: RodModel, scale: Scale, slack: float, options: RegistrationOptions
) -> _Labelled | None:
    """The labels of a slice at a scale known to ``slack``, if they are certain."""
    registration = _register_loosely(item, model, scale, slack, options)
    best = registration.best
    if registration.status != "ok" or best is None or len(best.rod_index) < _LEAST_SPOTS:
        return None
    return _Labelled(
        place=place, T=best.T_slice_model, spot_of_rod=best.spot_of_rod(len(model)), log_odds=best.log_odds
    )


def _register_loosely(
    item: SpotSlice, model: RodModel, scale: Scale, slack: float, options: RegistrationOptions
) -> Registration:
    """Register with spots as uncertain as a scale error of ``slack`` makes them at the frame's rim."""
    return register(
        _loosened(item.spots, model, scale, slack),
        model,
        scale=scale,
        T_patient_slice=item.info.T_patient_slice,
        thickness_mm=item.info.thickness_mm,
        shape=item.info.shape,
        options=options,
    )


def _loosened(spots: Spots, model: RodModel, scale: Scale, slack: float) -> Spots:
    extra = np.diag((slack * 0.5 * model.size_mm / scale.mm_per_px) ** 2)
    return Spots(uv_px=spots.uv_px, covariance_px=spots.covariance_px + extra)


def _fit(slices: Sequence[SpotSlice], labelled: Sequence[_Labelled], model: RodModel, start: Scale) -> _Fit:
    """Shared scales and one pose a slice, from labelled spots (weighted by their covariances).

    Rods that have a tolerance lean as well as lie beside their drawing, the same in every slice: their lines are
    estimated along (:func:`~ctreg_cli.registration.adjustment.adjust`), or they would pull at the scales.
    """
    uv = np.stack([slices[x.place].spots.uv_px[x.spot_of_rod] for x in labelled])
    covariance = np.stack([slices[x.place].spots.covariance_px[x.spot_of_rod] for x in labelled])
    matched = np.stack([x.spot_of_rod >= 0 for x in labelled])
    T = np.stack([x.T for x in labelled])
    seen = Observations(uv_px=uv, covariance_px=covariance, matched=matched, mm_per_px=start.mm_per_px)
    with np.errstate(invalid="ignore", divide="ignore"):  # what runs away is not believed
        fit = refine_scales(model, T, seen)
    if not (model.tolerances > 0).any() or not np.isfinite(fit.chi2):
        return _Fit(
            mm_per_px=fit.mm_per_px,
            covariance=fit.covariance,
            T=fit.T,
            pose_covariance=fit.pose_covariance,
            matched=matched,
            residual_px=fit.linearisation.residual_px,
            chi2=fit.chi2,
            degrees_of_freedom=fit.degrees_of_freedom,
        )
    b = len(labelled)
    scan = ScanSpots(
        observations=replace(seen, mm_per_px=np.tile(fit.mm_per_px, (b, 1))),
        T_patient_slice=np.tile(np.eye(4), (b, 1, 1)),
        pose_index=np.arange(b),
    )
    found = adjust(model, fit.T, scan, free_scales=True, reject=False)
    scale = fit.mm_per_px * np.exp(found.log_scale)
    widened = found.inflation**2
    return _Fit(
        mm_per_px=scale,
        covariance=found.log_scale_covariance / widened * np.outer(scale, scale),
        T=found.T_patient_model,
        pose_covariance=found.covariance / widened,
        matched=matched,
        residual_px=found.residual_px,
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
    )


def _search_scales(
    slices: Sequence[SpotSlice], usable: list[int], model: RodModel, options: RegistrationOptions
) -> tuple[list[_Labelled], _Fit | None]:
    """Walk the grid of scales on one slice; the scale that explains most, confirmed on all slices, wins.

    Nearly all rods seen is the quick and likely case and is tried for every aspect ratio first; a match of few of them
    is looked for with square pixels only.
    """
    # most spots of the frame and least clutter: near the frame's own number of rods
    first = slices[min(usable, key=lambda p: abs(len(slices[p].spots) - len(model)))]
    whole = min(len(first.spots), len(model))
    low, high = SCALE_RANGE
    grid = np.geomspace(low, high, math.ceil(math.log(high / low) / math.log(_GRID_STEP)) + 1)
    tries = [(max(whole - 1, _LEAST_SPOTS), aspect) for aspect in _ASPECTS]
    if whole - 1 > _LEAST_SPOTS:
        tries.append((_LEAST_SPOTS, 1.0))
    for least, aspect in tries:
        starts: list[tuple[float, Scale]] = []
        for middle in grid:
            scale = Scale(s_x=float(middle * math.sqrt(aspect)), s_y=float(middle / math.sqrt(aspect)))
            odds = _odds_at(first, model, scale, options, least)
            if odds > _START_LOG_ODDS:
                starts.append((odds, scale))
        best: tuple[float, list[_Labelled], _Fit] | None = None
        for _, scale in sorted(starts, key=lambda x: -x[0])[:_MOST_STARTS]:
            labelled, fit = _fit_from(slices, usable, model, scale, _SLACK_GRID, options)
            if fit is None:
                continue
            worth = sum(x.log_odds for x in labelled)
            if best is None or worth > best[0] + 1e-6:
                best = (worth, labelled, fit)
        if best is not None:
            return best[1:]
    return [], None


def _odds_at(item: SpotSlice, model: RodModel, scale: Scale, options: RegistrationOptions, least_matches: int) -> float:
    """ln odds of the best match of one slice at a grid scale."""
    scene = make_scene(
        _loosened(item.spots, model, scale, _SLACK_GRID),
        model,
        scale,
        T_patient_slice=item.info.T_patient_slice,
        thickness_mm=item.info.thickness_mm,
        shape=item.info.shape,
        options=options,
    )
    matches = search(model, scene, least_matches=least_matches)
    return -math.inf if matches is None else float(matches.log_odds[0])


def _report(
    slices: Sequence[SpotSlice], model: RodModel, nominal: Scale | None, labelled: list[_Labelled], fit: _Fit
) -> CalibrationRun:
    inflation = 1.0
    if chdtrc(fit.degrees_of_freedom, fit.chi2) < INFLATE_P:
        inflation = math.sqrt(fit.chi2 / fit.degrees_of_freedom)
    sd = np.sqrt(np.diag(fit.covariance)) * inflation
    residual = fit.residual_px[fit.matched]
    used = tuple(x.place for x in labelled)
    left_out = {
        place: "unreadable" if item.problem else "too_few_spots" if len(item.spots) < _LEAST_SPOTS else "not_certain"
        for place, item in enumerate(slices)
        if place not in set(used)
    }
    calibration = Calibration(
        scale=Scale(s_x=float(fit.mm_per_px[0]), s_y=float(fit.mm_per_px[1])),
        sd_s_x=float(sd[0]),
        sd_s_y=float(sd[1]),
        n_slices=len(labelled),
        n_spots=int(fit.matched.sum()),
        rms_px=float(np.sqrt((residual**2).mean())),
        nominal=nominal,
        model_name=model.name,
        model_sha256=model.sha256,
    )
    return CalibrationRun(
        calibration=calibration,
        used=used,
        T_slice_model=fit.T,
        covariance=fit.pose_covariance * inflation**2,
        left_out=left_out,
        inflation=inflation,
    )
