"""Spots of slice after slice: where a rod's spot is alone and looks as it did, one step of the fit is all it takes.

The centre always comes from the pixels of the slice at hand. What is kept from slice to slice is what the fit starts
from (:mod:`.profile`: height, shape, background) and the weights of its pixels; from there one Gauss–Newton step ends
within a small part of the noise of where the full fit ends. Its covariance follows the law of :mod:`.law`:
noise, and structure about the spot, are measured every few slices and when residuals change. Whatever is not plainly
what it was is measured as in :func:`.segmentation.measure_spots`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import starmap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.imaging.blob import (
    LONE_SHARES,
    LONE_SPREADS,
    Blobs,
    ellipse,
    measure_lone_blobs,
    monomials,
)
from ctreg_cli.imaging.fit import FLATNESS_RANGE, LONG_FLATNESS_PRIOR, PRIOR
from ctreg_cli.imaging.law import Law, centre_columns, centre_law, structure_near
from ctreg_cli.imaging.localisation import are_masks
from ctreg_cli.imaging.peaks import rate_peaks
from ctreg_cli.imaging.plateau import LONG_RATIO, LongSpots
from ctreg_cli.imaging.profile import BACKGROUND, CENTRE, FLATNESS, LOG_HEIGHT, N_PARAMETERS, SHAPE, Rows, moved
from ctreg_cli.imaging.profiles import (
    NEAR_PX,
    NOISE_BEYOND_PX,
    START_LEVEL,
    START_LOG_BETA,
    Profiles,
    distance_beyond_edge,
    fit_profiles,
    misfit_of,
    root_pixel_weights,
)
from ctreg_cli.imaging.segmentation import DEFAULT_OPTIONS, SMOOTHING_LOSS, SegmentationOptions, measure_spots
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.imaging.uncertainty import noise_field
from ctreg_cli.imaging.window import UprightImage, disc, grid

#: radius of the windows, px: the least of those that the search tries
RADIUS_PX = 8
#: rows beyond where spots are looked for that are read with them: a window about a spot at the edge, twice, in case it
#: has to be moved there
ROWS_BEYOND = 3 * RADIUS_PX
#: a spot no farther from the middle of its window than this, px along u and v, is seen as well as one in the middle
MAX_OFF_MIDDLE_PX = 1.0
#: steps at most; the last must have moved the contours by less than this (in half widths) and changed height, shape and
#: flatness by less than this (in ln)
MAX_STEPS, LAST_STEP, LAST_STEP_LN = 5, 0.06, 0.12
#: height and shape change by about so much (in ln) from slice to slice: where a spot is cut off, its pixels tell little
#: of its height, and what they tell shall not throw the fit about; the centre is not touched by any of that
SLICE_TO_SLICE_LN = 0.1
#: length and thickness are remembered over about so many slices; a spot for which one is this many times what it was is
#: not the same any more, nor one that became long, or is not any more, beyond doubt
AXES_MEMORY, MAX_CHANGE, LONG_DOUBT = 4.0, 1.5, 1.15
#: mean squares of residuals beyond so many times what they were are something new in the window
MAX_MISFIT = 3.0
#: noise, and what it makes of the centres, is measured anew after so many slices, or when its sd changes by this factor
#: (looked at when the mean square of residuals does by that), or the flatness of a long spot by so much
LAW_EVERY, NOISE_CHANGE, LAW_CHANGE, LAW_FLATNESS = 64, 1.5, 1.7, 0.15
#: structure about a spot is looked for when that mean square changes by this factor: by chance in one slice of ten;
#: a streak that widens a centre (:data:`~ctreg_cli.imaging.uncertainty.SURE_OF_STRUCTURE`) changes it by more
STRUCTURE_CHANGE = 1.5
#: everything is measured in full again after so many slices
MAX_AGE = 256
#: after a spot could not be learned, that is not tried for so many slices, twice as many each time
FIRST_WAIT, MAX_WAIT = 1, 64


def _prior() -> FloatArray:
    """(10,): inverse variances of the steps from slice to slice; flatness has one of its own beside."""
    prior = PRIOR[:, 0].copy()
    prior[LOG_HEIGHT] = prior[SHAPE] = prior[FLATNESS] = SLICE_TO_SLICE_LN**-2
    return prior


def _last_step() -> FloatArray:
    """(10, 1): what the last step must not exceed; background and its gradient may do as they like."""
    limit = np.full((N_PARAMETERS, 1), np.inf)
    limit[CENTRE], limit[LOG_HEIGHT], limit[SHAPE], limit[FLATNESS] = LAST_STEP, *(3 * [LAST_STEP_LN])
    return limit


_PRIOR_MATRIX, _LAST_STEP = np.diag(_prior()), _last_step()


class Follower:
    """Measures the spots of one frame in slice after slice; one a sequence, not thread-safe."""

    def __init__(self, options: SegmentationOptions = DEFAULT_OPTIONS) -> None:
        self.options = options
        self._known: _Known | None = None
        #: slices since anything was measured in full, and since the law of the centres was measured
        self._age = self._law_age = 0
        #: of rods whose spots could not be learned: slices to go until that is tried again, and how many there were
        self._waits: dict[int, tuple[int, int]] = {}

    def forget(self) -> None:
        """All spots are measured in full in the next slice."""
        self._known = None

    def measure(self, slice_: Slice, rods: IntArray, uv_px: FloatArray, radius_px: FloatArray) -> Spots:
        """Spots within ``radius_px`` (k,) of where the spots of ``rods`` are expected, ``uv_px`` (k, 2).

        What is returned is what :func:`~ctreg_cli.imaging.segmentation.measure_spots` returns, but for a small part of
        the noise, and for the order of the spots.

        Args:
            slice_: the image.
            rods: (k,) numbers that tell the rods apart, rising.
            uv_px: centres predicted, px.
            radius_px: how far off they may be, px.
        """
        known, self._known = self._known, None  # what is not found again is not known any more
        self._age += 1
        if known is None or self._age > MAX_AGE or self.options.polarity == "auto":
            return self._measured_in_full(slice_, rods, uv_px, radius_px)
        here = None if rods.tolist() == known.rods.tolist() else np.isin(rods, known.rods)
        if here is not None and not here.any():
            return self._measured_in_full(slice_, rods, uv_px, radius_px)
        windows = _Windows.of(slice_, uv_px[:, 1], radius_px, bright=self.options.polarity == "bright")
        if windows is None:
            return self._measured_in_full(slice_, rods, uv_px, radius_px)
        if here is None:
            seen, found = self._follow(windows, known, uv_px, radius_px)
            if all(found.tolist()):
                return seen
            rest = ~found
        else:
            known = known.take(np.isin(known.rods, rods))
            seen, found = self._follow(windows, known, uv_px[here], radius_px[here])
            rest = ~here
            rest[here] = ~found
        others = self._measured_in_full(slice_, rods[rest], uv_px[rest], radius_px[rest])
        return _together(seen, others, self.options)

    def _measured_in_full(self, slice_: Slice, rods: IntArray, uv: FloatArray, radius: FloatArray) -> Spots:
        """Spots of rods of which nothing is known; how they look is remembered where one is alone and expected."""
        spots = measure_spots(slice_, uv, radius, self.options)
        if not len(spots) or self.options.polarity == "auto" or not _is_plain(slice_.stored):
            return spots
        if self._known is None:
            self._age = 0
        distance = np.hypot(*(uv[:, None] - spots.uv_px).transpose(2, 0, 1))
        unknown = np.isin(rods, () if self._known is None else self._known.rods, invert=True)
        due = (np.count_nonzero(distance <= radius[:, None], axis=1) == 1) & unknown
        due[due] = [*map(self._is_due, rods[due])]
        if due.any():
            image = UprightImage.of(slice_, bright=self.options.polarity == "bright")
            middles = np.rint(spots.uv_px[distance[due].argmin(axis=1)]).astype(np.intp)
            blobs, lone = measure_lone_blobs(image, middles, RADIUS_PX)
            blobs, learned = blobs.take(lone), rods[due][lone]
            if len(learned):
                self._learn(learned, blobs, image.ceiling)
        return spots

    def _learn(self, rods: IntArray, blobs: Blobs, ceiling: float) -> None:
        """Remember how the spots of rods (k,) look, but for those of which a step is worth no more than a fit."""
        fitted = fit_profiles(blobs, ceiling)
        smooth = ~(fitted.sharp | fitted.flat | are_masks(blobs))
        if not smooth.any():
            return
        if not smooth.all():
            blobs, rods = blobs.take(smooth), rods[smooth]
            fitted = fit_profiles(blobs, ceiling)
        self._waits |= dict.fromkeys(rods.tolist(), (0, 0))
        known = _Known.of(rods, blobs, fitted)
        self._known = known if self._known is None else self._known.joined(known)

    def _is_due(self, rod: int) -> bool:
        """Whether to try and learn how the spot of a rod looks; the next try, should it fail, comes later and later."""
        left, waited = self._waits.get(rod, (0, 0))
        if left > 0:
            self._waits[rod] = left - 1, waited
            return False
        waited = min(max(2 * waited, FIRST_WAIT), MAX_WAIT)
        self._waits[rod] = waited, waited
        return True

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # steps that wander off are not relied on
    def _follow(self, windows: _Windows, known: _Known, uv: FloatArray, radius: FloatArray) -> tuple[Spots, BoolArray]:
        """Spots of those known rods (k,) that a step from what is known measures, and which rods these are."""
        middles, values, brightest, good = windows.about(uv, known)
        region = _Region.of(values > known.half[:, None])
        fitted, shift, close = _stepped(known, region, values, brightest)
        looks = _Looks.of(fitted)

        good &= close & looks.are_those_of(known, self.options) & region.is_that_of(known)
        centre = middles + fitted.centre.T
        off = _length(centre - uv)
        good &= off <= radius
        near = _near_each_other(centre)
        if np.count_nonzero(near) > len(near):  # each is near itself
            good &= np.count_nonzero(near, axis=1) == 1
        # where more has to be looked at than the windows show, and something is there, a rod is known all the same
        crowded = np.zeros(len(good), dtype=bool)
        beyond = off + radius > RADIUS_PX
        if any(beyond.tolist()):
            level = fitted.parameters[BACKGROUND] + known.most_beside(fitted.height)
            least = SMOOTHING_LOSS * self.options.min_relative_contrast * float(fitted.height.max())
            crowded = good & beyond & ~windows.nothing_else(centre, uv, radius, level, good, least)
            good &= ~crowded

        formal = _formal_variance(fitted.parameters, shift)
        self._law_age += 1
        is_due = self._law_age > LAW_EVERY or known.is_shaped_otherwise(fitted, good)
        if not is_due and looks.have_changed(known):
            # with noise, or with something else that is about a spot
            is_due = known.is_in_other_noise(fitted, good)
            if not is_due:
                known.misfit = looks.misfit
        if is_due:
            self._law_age = 0
            known.measured(centre_law(fitted, shift, RADIUS_PX), formal, looks, fitted)
        if is_due or looks.may_show_other_structure(known):
            known.surroundings(structure_near(fitted, known.law.rough, RADIUS_PX), looks)
        covariance = known.law.scaled(known.unscaled, formal / known.formal, looks.misfit)
        good &= np.isfinite(covariance[:, 0, 0] + covariance[:, 1, 1])
        spots = Spots.of_own(
            uv_px=centre,
            covariance_px=covariance,
            area_px=region.area,
            contrast=fitted.height * windows.unit,
            major_px=region.axes[0],
            minor_px=region.axes[1],
            angle_rad=region.angle,
        )
        known.seen(fitted, region)
        if all(good.tolist()):
            self._known = known
            return spots, good
        still_known = good | (crowded & np.isfinite(covariance[:, 0, 0]))
        if still_known.any():
            self._known = known.take(still_known)
        return spots.take(good), good


@dataclass(slots=True, kw_only=True, eq=False)
class _Known:
    """How the spots of ``k`` rods looked in the last slice."""

    #: (k,) rising
    rods: IntArray
    #: (10, k)
    parameters: FloatArray
    #: which are long, and coordinates (2, p) or (2, k, p) of the pixels of a window as the spots see them
    long: LongSpots
    coordinates: FloatArray
    #: (k,) mean and inverse variance of what flatness may be
    flatness: FloatArray
    flatness_prior: FloatArray
    #: (2, k) length and thickness, px
    axes: FloatArray
    #: (k,) what lies above this value is the spot and nothing else; and half of its height
    level: FloatArray
    half: FloatArray
    #: (k,) what pixels are weighted by, as in :class:`~ctreg_cli.imaging.profiles.Profiles`
    noise: FloatArray
    structure_slope: FloatArray
    #: value at which the image is cut off
    ceiling: float
    #: of the centres, measured some slices ago; from then are the variances (k,) that the profiles alone made, how
    #: large residuals were (:class:`_Looks`), and the flatness
    law: Law
    formal: FloatArray
    misfit: FloatArray
    beside: FloatArray
    flatness_then: FloatArray
    #: variance (k,) of structure about the centres, and how large residuals were when it was looked for; what it and
    #: noise make of the centres (k, 2, 2), see :meth:`~ctreg_cli.imaging.law.Law.made_by`
    structure: FloatArray
    misfit_then: FloatArray
    unscaled: FloatArray

    @classmethod
    def of(cls, rods: IntArray, blobs: Blobs, fitted: Profiles) -> _Known:
        """Of profiles fitted in full."""
        shift, looks, long = centre_columns(fitted.normal), _Looks.of(fitted), fitted.long
        law = centre_law(fitted, shift, RADIUS_PX)
        structure = structure_near(fitted, law.rough, RADIUS_PX)
        background, height, flatness = fitted.parameters[BACKGROUND], fitted.height, fitted.parameters[FLATNESS]
        return cls(
            rods=rods,
            parameters=fitted.parameters,
            long=long,
            coordinates=_coordinates_of(long),
            flatness=np.where(long.mask, flatness, START_LOG_BETA),
            flatness_prior=np.where(long.mask, LONG_FLATNESS_PRIOR, PRIOR[FLATNESS]),
            axes=np.stack(blobs.axes[:2]),
            level=background + START_LEVEL * height,
            half=background + 0.5 * height,
            noise=fitted.noise,
            structure_slope=fitted.structure_slope,
            ceiling=fitted.ceiling,
            law=law,
            formal=_formal_variance(fitted.parameters, shift),
            misfit=looks.misfit,
            beside=looks.beside,
            flatness_then=flatness,
            structure=structure,
            misfit_then=looks.misfit,
            unscaled=law.made_by(structure),
        )

    def most_beside(self, height: FloatArray) -> FloatArray:
        """How far (k,) anything may stand out beside spots so high (k,); see :mod:`.blob`."""
        least, most = LONE_SHARES
        limit: FloatArray = np.minimum(np.maximum(LONE_SPREADS * self.law.rough, least * height), most * height)
        return limit

    def is_shaped_otherwise(self, fitted: Profiles, good: BoolArray) -> bool:
        """Whether a ``good`` (k,) long spot is flatter, or less flat, than when the law was measured."""
        if not len(self.long):
            return False
        flatter = np.abs(fitted.parameters[FLATNESS] - self.flatness_then) > LAW_FLATNESS
        return bool((flatter & self.long.mask & good).any())

    def is_in_other_noise(self, fitted: Profiles, good: BoolArray) -> bool:
        """Whether the noise about a ``good`` (k,) spot is no longer what it was when the law was measured."""
        rough, _, _ = noise_field(fitted.residuals, fitted.quiet, RADIUS_PX)
        noisier = rough / self.law.rough
        return bool((((noisier > NOISE_CHANGE) | (noisier < 1.0 / NOISE_CHANGE)) & good).any())

    def measured(self, law: Law, formal: FloatArray, looks: _Looks, fitted: Profiles) -> None:
        """Remember the law, and what it was measured with.

        Residuals that were small by chance must not make those of the next slice look large: of the mean squares now
        and then, the geometric mean is what the next are compared with.
        """
        self.law, self.formal, self.misfit, self.beside = law, formal, np.sqrt(self.misfit * looks.misfit), looks.beside
        self.flatness_then = fitted.parameters[FLATNESS]

    def surroundings(self, structure: FloatArray, looks: _Looks) -> None:
        """Remember the structure about the centres, what it makes of these, and what residuals it goes with."""
        self.structure, self.misfit_then, self.unscaled = structure, looks.misfit, self.law.made_by(structure)

    def seen(self, fitted: Profiles, region: _Region) -> None:
        """Remember how the spots look now."""
        background = fitted.parameters[BACKGROUND]
        self.parameters, self.ceiling = fitted.parameters, fitted.ceiling
        self.level = background + START_LEVEL * fitted.height
        self.half = background + 0.5 * fitted.height
        self.axes = self.axes + (region.axes - self.axes) / AXES_MEMORY

    def take(self, which: BoolArray | IntArray) -> _Known:
        """Some of the rods."""
        long = self.long.take(which)
        return _Known(
            rods=self.rods[which],
            long=long,
            coordinates=_coordinates_of(long),
            ceiling=self.ceiling,
            law=self.law.take(which),
            unscaled=self.unscaled[which],
            **{name: getattr(self, name)[..., which] for name in _OF_EACH},
        )

    def joined(self, other: _Known) -> _Known:
        """These rods and others."""
        rods, long = np.concatenate([self.rods, other.rods]), self.long.joined(other.long)
        return _Known(
            rods=rods,
            long=long,
            coordinates=_coordinates_of(long),
            ceiling=max(self.ceiling, other.ceiling),
            law=self.law.joined(other.law),
            unscaled=np.concatenate([self.unscaled, other.unscaled]),
            **{name: np.concatenate([getattr(self, name), getattr(other, name)], axis=-1) for name in _OF_EACH},
        ).take(np.argsort(rods))


#: arrays of a :class:`_Known` whose last axis counts the rods
_OF_EACH = (
    *("parameters", "flatness", "flatness_prior", "axes", "level", "half", "noise", "structure_slope"),
    *("formal", "misfit", "beside", "flatness_then", "structure", "misfit_then"),
)


class _Region(NamedTuple):
    """What of ``k`` windows lies above half height."""

    own: BoolArray
    #: (k,) px²
    area: FloatArray
    #: (2, k) from the windows' middles, px, and (3, k), see :func:`~ctreg_cli.imaging.profiles.distance_beyond_edge`
    middle: FloatArray
    edge: FloatArray
    #: (2, k) long and short axis, px; and the angle (k,) of the long one, rad
    axes: FloatArray
    angle: FloatArray

    @classmethod
    def of(cls, own: BoolArray) -> _Region:
        sums = own.astype(np.float64).dot(_monomials())
        ellipses = np.array([*starmap(ellipse, sums.tolist())]).T
        return cls(
            own=own,
            area=sums[:, 0].copy(),
            middle=ellipses[:2],
            edge=ellipses[2:5],
            axes=ellipses[5:7],
            angle=ellipses[7].copy(),
        )

    def is_that_of(self, known: _Known) -> BoolArray:
        """Whether (k,) a spot is as long and thick as it was, and has not become long or round."""
        is_long = known.long.mask.tolist()
        return np.array([*map(_is_same_shape, *self.axes.tolist(), *known.axes.tolist(), is_long)])


def _is_same_shape(long: float, thick: float, length_was: float, thickness_was: float, is_long: bool) -> bool:
    """Whether a spot is as long and thick as it was, and had not become long or round by then."""
    longer, thicker = long / length_was, thick / thickness_was
    same = 1.0 / MAX_CHANGE < longer < MAX_CHANGE and 1.0 / MAX_CHANGE < thicker < MAX_CHANGE
    least_ratio = LONG_RATIO / LONG_DOUBT if is_long else LONG_RATIO * LONG_DOUBT
    return same and (length_was > least_ratio * thickness_was) == is_long


class _Looks(NamedTuple):
    """What fits left: mean squares (k,) of the weighted residuals, and the greatest residual (k,) beside each spot."""

    height: FloatArray
    misfit: FloatArray
    beside: FloatArray

    @classmethod
    def of(cls, fitted: Profiles) -> _Looks:
        return cls(
            height=fitted.height,
            misfit=misfit_of(fitted.rows.by_spot),
            beside=np.where(fitted.quiet, fitted.residuals, -np.inf).max(axis=1),
        )

    def are_those_of(self, known: _Known, options: SegmentationOptions) -> BoolArray:
        """Whether (k,) nothing has come up in a spot or beside it."""
        same = self.misfit < MAX_MISFIT * known.misfit
        same &= self.beside < known.beside + known.most_beside(self.height)
        same &= self.height > options.min_contrast_sd * known.law.rough
        return np.asarray(same)

    def may_show_other_structure(self, known: _Known) -> bool:
        """Whether residuals about any spot are larger than when structure was looked for, or smaller where there was.

        By more than chance.
        """
        change = self.misfit / known.misfit_then
        other = change > STRUCTURE_CHANGE
        if any(known.structure.tolist()):
            other |= (known.structure > 0) & (change < 1.0 / STRUCTURE_CHANGE)
        return any(other.tolist())

    def have_changed(self, known: _Known) -> bool:
        """Whether residuals about any spot are no longer what they were when the law was measured."""
        change = (self.misfit / known.misfit).tolist()
        return bool(max(change) >= LAW_CHANGE or min(change) <= 1.0 / LAW_CHANGE)


def _stepped(
    known: _Known, region: _Region, values: FloatArray, brightest: FloatArray
) -> tuple[Profiles, FloatArray, BoolArray]:
    """Profiles a Gauss–Newton step or a few from what is known, and whether (k,) they can be relied on.

    Between these: the first two columns (k, 10, 2) of the inverses of the normal matrices. The rows of the profiles
    hold the derivatives before the last step, and the residuals after it as those tell them.

    Args:
        known: where the fit starts from.
        region: what lies above half height.
        values: (k, p) windows.
        brightest: (2, k) centres of gravity to start from.
    """
    u, v, _ = _coordinates()
    distance = distance_beyond_edge(region.edge, u - region.middle[0, :, None], v - region.middle[1, :, None])
    root_weights = root_pixel_weights(distance, known.noise, known.structure_slope)
    brightest_value = float(values.max())
    ceiling, cut_off = max(known.ceiling, brightest_value), None
    n_clipped = np.zeros(len(values), dtype=np.intp)
    if brightest_value >= ceiling:
        cut_off = values >= ceiling
        n_clipped = (cut_off & region.own).sum(axis=1)
    cut = n_clipped > 0
    if not any(cut.tolist()):
        cut_off = None
    long = known.long if len(known.long) else None
    along, across = known.coordinates
    rows = Rows(along, across, values, cut_off, root_weights, None if long is None else long.mask)
    parameters = known.parameters.copy()
    parameters[CENTRE] = brightest if long is None else long.turned(brightest)

    for n_left in reversed(range(MAX_STEPS)):
        products = rows.evaluate(parameters)
        normal = products[:, :-1] + _PRIOR_MATRIX
        normal[:, FLATNESS, FLATNESS] += known.flatness_prior
        gradient = products[:, -1]
        gradient[:, FLATNESS] -= known.flatness_prior * (parameters[FLATNESS] - known.flatness)
        shift, step = _solved(normal, gradient)
        few = np.abs(step) < _LAST_STEP
        few[LOG_HEIGHT] |= cut  # where a spot is cut off, its height may be anything, and moves nothing else
        small = few.all(axis=0)
        parameters = moved(parameters, step)
        if not n_left or small.all():
            break
    rows.by_spot[:, -1] -= (step.T[:, None] @ rows.by_spot[:, :-1])[:, 0]
    low, high = FLATNESS_RANGE
    small &= (parameters[FLATNESS] >= low) & (parameters[FLATNESS] <= high)
    fitted = Profiles(
        parameters=parameters,
        long=known.long,
        centre=parameters[CENTRE] if long is None else long.turned_back(parameters[CENTRE]),
        normal=normal,
        rows=rows,
        residuals=rows.by_spot[:, -1] / root_weights,
        noise=known.noise,
        structure_slope=known.structure_slope,
        near=(distance > NEAR_PX[0]) & (distance < NEAR_PX[1]),
        quiet=distance > NOISE_BEYOND_PX,
        height=np.minimum(np.exp(parameters[LOG_HEIGHT]), np.maximum(ceiling - parameters[BACKGROUND], 1.0)),
        n_clipped=n_clipped,
        sharp=np.zeros(len(n_clipped), dtype=bool),
        flat=np.zeros(len(n_clipped), dtype=bool),
        ceiling=ceiling,
    )
    return fitted, shift, np.asarray(small)


def _solved(normal: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The first two columns (k, 10, 2) of the inverses of normal matrices (k, 10, 10), and the steps (10, k).

    All NaN where one of the matrices is singular.
    """
    wanted = np.zeros((len(normal), N_PARAMETERS, 3))
    wanted[:, 0, 0] = wanted[:, 1, 1] = 1.0
    wanted[:, :, 2] = gradient
    try:
        solved: FloatArray = np.asarray(np.linalg.solve(normal, wanted), dtype=np.float64)
    except np.linalg.LinAlgError:
        solved = np.full_like(wanted, np.nan)
    return solved[:, :, :2], solved[:, :, 2].T


def _formal_variance(parameters: FloatArray, shift: FloatArray) -> FloatArray:
    """(k,) of the centre along u and v together, were the weights all that is known of the noise."""
    along_u, _, along_v = np.exp(-2.0 * parameters[SHAPE])
    return np.asarray(shift[:, 0, 0] * along_u + shift[:, 1, 1] * along_v)


class _Windows(NamedTuple):
    """The pixels of some rows of a slice, spots upright; only integers, so that each is a value."""

    source: Slice
    is_bright: bool
    #: the rows in one line, the first of them, and their (number, columns)
    stored: NDArray[Any]
    first_row: int
    shape: tuple[int, int]
    sign: float
    unit: float
    #: range of upright values that are no image
    padding: tuple[float, float] | None

    @classmethod
    def of(cls, slice_: Slice, v: FloatArray, radius: FloatArray, *, bright: bool) -> _Windows | None:
        """The rows about places ``v`` (k,) where spots are looked for within ``radius`` (k,), px.

        None where windows of such pixels cannot be taken by one index, or do not mean one thing.
        """
        n_rows = slice_.info.shape[0] if slice_.info.shape is not None else len(slice_.stored)
        at, around = v.tolist(), max(radius.tolist()) + ROWS_BEYOND
        first, end = max(int(min(at) - around), 0), min(int(max(at) + around), n_rows)
        rows = slice_.rows(first, max(first, end))
        if not _is_plain(rows):
            return None
        sign = math.copysign(1.0, slice_.slope) * (1.0 if bright else -1.0)
        padding = slice_.padding
        if padding is not None and sign < 0:
            padding = -padding[1], -padding[0]
        return cls(
            source=slice_,
            is_bright=bright,
            stored=rows.reshape(-1),
            first_row=first,
            shape=rows.shape,
            sign=sign,
            unit=abs(slice_.slope),
            padding=padding,
        )

    def about(self, uv: FloatArray, known: _Known) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        """Windows about ``uv`` (k, 2), or if need be about the centres of gravity of what is bright there.

        Returns:
            Middle pixels (k, 2), upright values (k, p) on discs about them, those centres (2, k) from the middles, and
            which discs show nothing but image.
        """
        middles = np.rint(uv)
        values = self._at(middles, RADIUS_PX)
        weights = values - known.level[:, None]
        np.maximum(weights, 0.0, out=weights)
        sums = weights.dot(_coordinates()[2])
        off = sums[:, :2] / np.maximum(sums[:, 2:], 1e-9)
        if np.abs(off).max() > MAX_OFF_MIDDLE_PX:
            centre = middles + off
            middles = np.rint(centre)
            off = centre - middles
            values = self._at(middles, RADIUS_PX)
        good = self._inside(middles, RADIUS_PX)
        if self._may_be_padding(values):
            good &= ~self._is_padding(values).any(axis=1)
        return middles, values, off.T, good

    def nothing_else(
        self, centre: FloatArray, uv: FloatArray, radius: FloatArray, level: FloatArray, good: BoolArray, least: float
    ) -> BoolArray:
        """Whether no peak within ``radius`` (k,) of ``uv`` (k, 2) is above a ``level`` (k,) but the spots themselves.

        Those are what lies in the windows about the ``centre`` (k, 2) of each ``good`` (k,) one, which have been looked
        at; about ``uv`` of the others all will be measured in full. A streak that only rises towards something farther
        off has no peak, and one that stands out of what is about it by less than ``least`` could be no spot.
        """
        reach = math.ceil(float(radius.max()))
        middles = np.rint(uv)
        values = self._at(middles, reach)
        bright = values > level[:, None]
        if self._may_be_padding(values):
            bright &= ~self._is_padding(values)
        spot, pixel = np.nonzero(bright)
        u, v = (axis.ravel()[disc(reach)] for axis in grid(reach))
        at = middles[spot] + np.stack([u[pixel], v[pixel]], axis=1)
        wanted = _length(at - uv[spot]) <= radius[spot]
        spot, at = spot[wanted], at[wanted]
        places, reaches = np.where(good[:, None], centre, uv), np.where(good, RADIUS_PX - 1.0, radius)
        unseen = (_length(at[:, None] - places) > reaches).all(axis=1)
        spot, at = spot[unseen], at[unseen].astype(np.intp)
        clear = self._inside(middles, reach + 2)
        if len(spot):
            clear[spot[self._has_peak(at, least)]] = False
        return clear

    def _has_peak(self, pixels: IntArray, least: float) -> BoolArray:
        """Whether (m,) one of the nine pixels about each of ``pixels`` (m, 2) is brighter than its own neighbours.

        Means of nine pixels are compared, so that noise does not make peaks of its own. These must stand out by
        ``least``, as :func:`~ctreg_cli.imaging.peaks.rate_peaks` sees it. Next to padding all is a peak.
        """
        rows, columns = self.shape
        u, v = pixels[:, 0], pixels[:, 1] - self.first_row
        inside = (np.minimum(u, v) >= 3) & (u < columns - 3) & (v < rows - 3)
        around = np.arange(-3, 4)
        at = (v * columns + u)[:, None, None] + around[:, None] * columns + around
        values = self.sign * self.stored.take(at, mode="clip").astype(np.float64)
        means = np.lib.stride_tricks.sliding_window_view(values, (3, 3), axis=(1, 2)).mean(axis=(3, 4))
        greatest = np.lib.stride_tricks.sliding_window_view(means, (3, 3), axis=(1, 2)).max(axis=(3, 4))
        peak = (means[:, 1:-1, 1:-1] >= greatest).any(axis=(1, 2))
        at_peak = np.flatnonzero(peak & inside)
        if len(at_peak):
            image = UprightImage.of(self.source, bright=self.is_bright)
            heights = means[at_peak, 1:-1, 1:-1].max(axis=(1, 2))
            rated = rate_peaks(image, pixels[at_peak], heights, 0.5 * RADIUS_PX)
            peak[at_peak] = rated.contrast >= least
        if self._may_be_padding(values):
            peak |= self._is_padding(values).any(axis=(1, 2))
        return np.asarray(peak | ~inside)

    def _inside(self, middles: FloatArray, radius: int) -> BoolArray:
        """Which (k,) windows about ``middles`` (k, 2) lie in the image."""
        rows, columns = self.shape
        right, first, end = columns - radius, self.first_row + radius, self.first_row + rows - radius
        return np.array([radius <= u < right and first <= v < end for u, v in middles.tolist()])

    def _at(self, middles: FloatArray, radius: int) -> FloatArray:
        """Upright values (k, p) on discs about whole pixels (k, 2); beyond the image they mean nothing."""
        columns = self.shape[1]
        at = ((middles[:, 1] - self.first_row) * columns + middles[:, 0]).astype(np.intp)
        values: FloatArray = self.stored.take(at[:, None] + _offsets(radius, columns), mode="clip").astype(np.float64)
        return values if self.sign > 0 else -values

    def _may_be_padding(self, values: FloatArray) -> bool:
        return self.padding is not None and self.padding[1] >= values.min() and self.padding[0] <= values.max()

    def _is_padding(self, values: FloatArray) -> BoolArray:
        assert self.padding is not None
        return np.asarray((values >= self.padding[0]) & (values <= self.padding[1]))


def _is_plain(stored: NDArray[Any]) -> bool:
    """Whether windows of an image, or of some of its rows, can be taken by one index, and mean one thing."""
    return stored.dtype.kind in "iu" and stored.flags.c_contiguous and min(stored.shape) > 2 * RADIUS_PX


def _near_each_other(centre: FloatArray) -> BoolArray:
    """(k, k) which of the places (k, 2) lie in one another's windows."""
    return np.asarray(_length(centre[:, None] - centre) <= RADIUS_PX)


def _length(vectors: FloatArray) -> FloatArray:
    """Of vectors (..., 2)."""
    return np.abs(vectors.view(np.complex128)[..., 0])  # one call for four


def _together(seen: Spots, others: Spots, options: SegmentationOptions) -> Spots:
    """All spots, the others without those seen already, and all without what is too faint beside the strongest."""
    if len(others) and len(seen):
        apart = np.hypot(*(others.uv_px[:, None] - seen.uv_px).transpose(2, 0, 1)).min(axis=1)
        others = others.take(apart > 0.5 * others.minor_px)
    spots = seen.joined(others)
    strong = spots.contrast >= options.min_relative_contrast * spots.contrast.max(initial=0.0)
    return spots if strong.all() else spots.take(strong)


@cache
def _coordinates() -> tuple[FloatArray, FloatArray, FloatArray]:
    """u and v (p,) of the pixels of a window's disc, and these and 1 as columns (p, 3)."""
    at = disc(RADIUS_PX)
    u, v = (axis.ravel()[at] for axis in grid(RADIUS_PX))
    return frozen(u, u.shape), frozen(v, v.shape), frozen(np.stack([u, v, np.ones(len(u))], axis=1), (len(u), 3))


def _coordinates_of(long: LongSpots) -> FloatArray:
    """(2, p), or (2, k, p) where some spots are long: of the pixels of a window's disc, as the spots see them."""
    u, v, _ = _coordinates()
    return long.coordinates(u, v) if len(long) else np.stack([u, v])


@cache
def _monomials() -> FloatArray:
    """(p, 7) rows of :func:`ctreg_cli.imaging.blob.monomials` at the pixels of a window's disc."""
    return monomials(RADIUS_PX)[disc(RADIUS_PX)]


@lru_cache(maxsize=16)
def _offsets(radius: int, columns: int) -> IntArray:
    """(p,) from a window's middle pixel to those of its disc, in an image in one line."""
    u, v = (axis.ravel()[disc(radius)] for axis in grid(radius))
    return frozen_index(v * columns + u)
