"""A frame judged: the public door of :mod:`ctreg_cli.design`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ctreg_cli.design.degeneracy import coincident_pairs, coplanar_triples, groups, parallel_triples
from ctreg_cli.design.prediction import (
    LINEAR_RANK,
    MIN_RODS_SEEN,
    POSE_RANK,
    DesignOptions,
    SliceQuality,
    qualities,
    sample_slices,
)
from ctreg_cli.design.symmetry import Symmetry, symmetries
from ctreg_cli.rods import RodModel

#: two poses whose rods differ by less than this many standard deviations of a rod's place are not told apart ...
TWIN_SD = 3.0
#: ... nor by less than spots of a common scanner can show
MIN_TWIN_MM = 0.3
#: a frame that does worse than this where most rods are seen deserves a remark
WEAK_ROTATION_DEG = 2.0
#: triples of rods grow with the cube of their number: no listing of sets and symmetries beyond this
MAX_RODS_LISTED = 50
#: from this number of rods on, a slice has redundancy to speak of (method §7)
REDUNDANT_RODS = 5


#: spots that make a pose without labels: three always fit
LEAST_RODS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignReport:
    """A frame judged; shares and medians are over ``options.samples`` slices at random heights and tilts."""

    name: str
    n_rods: int
    size_mm: float
    #: ids of the rods of each set of three or more parallel rods, and of each plane that holds three or more
    parallel_groups: tuple[tuple[str, ...], ...]
    coplanar_groups: tuple[tuple[str, ...], ...]
    n_parallel_triples: int
    n_coplanar_triples: int
    symmetries: tuple[Symmetry, ...]
    #: greatest rank met over the slices: of the motion field (6 fixes a pose), of the linear system (9 solves it)
    pose_rank: int
    linear_rank: int
    #: by number of rods seen, most first
    slices: tuple[SliceQuality, ...]
    #: names of the points of ``tre_mm``: the frame's centre, then its targets
    targets: tuple[str, ...]
    #: why the frame can never give a pose; empty when it can
    problems: tuple[str, ...]
    #: what a user should know
    remarks: tuple[str, ...]
    options: DesignOptions

    @property
    def usable(self) -> bool:
        """Whether the frame can give a pose at all."""
        return not self.problems


def check_design(model: RodModel, options: DesignOptions | None = None) -> DesignReport:
    """Judge ``model``: degenerate sets of rods, symmetries, rank and condition, and predicted accuracy.

    Sets and symmetries are exact (the latter to three times the rods' tolerance, at least 0.3 mm); the rest rests on
    seeded slices, so that the answer is the same every time.
    """
    options = options or DesignOptions()
    listed = model if len(model) <= MAX_RODS_LISTED else model.subset(range(MAX_RODS_LISTED))
    parallel, coplanar = parallel_triples(listed), coplanar_triples(listed)
    whole = listed is model
    twins = symmetries(model, within_mm=max(MIN_TWIN_MM, TWIN_SD * float(model.tolerances.max()))) if whole else ()
    slices = sample_slices(model, options)
    enough = slices.seen.sum(axis=1) >= MIN_RODS_SEEN
    pose_rank = int(slices.pose_rank[enough].max(initial=0))
    linear_rank = int(slices.linear_rank[enough].max(initial=0))
    quality = qualities(model, slices, options)
    parallel_groups, coplanar_groups = _named(model, groups(parallel)), _named(model, groups(coplanar))
    return DesignReport(
        name=model.name,
        n_rods=len(model),
        size_mm=model.size_mm,
        parallel_groups=parallel_groups,
        coplanar_groups=coplanar_groups,
        n_parallel_triples=len(parallel),
        n_coplanar_triples=len(coplanar),
        symmetries=twins,
        pose_rank=pose_rank,
        linear_rank=linear_rank,
        slices=quality,
        targets=("centre of rods", *(target.id for target in model.targets)),
        problems=tuple(_problems(model, parallel_groups, coplanar_groups, pose_rank)),
        remarks=tuple(_remarks(model, twins, linear_rank, quality)),
        options=options,
    )


def settled_by_mount(model: RodModel, symmetry: Symmetry) -> bool:
    """Whether no pose and its twin can both be within the mount's range."""
    return model.mount is not None and symmetry.angle_deg > 2 * model.mount.max_angle_deg


def _problems(
    model: RodModel, parallel: Iterable[tuple[str, ...]], coplanar: Iterable[tuple[str, ...]], pose_rank: int
) -> Iterator[str]:
    everything = set(model.ids)
    if any(set(group) == everything for group in parallel):
        yield "all rods are parallel: shifts along them cannot be seen in any slice"
    elif any(set(group) == everything for group in coplanar):
        yield "all rods lie in one plane: turns about the line where it meets a slice cannot be seen"
    elif pose_rank == 0:
        yield f"no slice cuts {MIN_RODS_SEEN} rods"
    elif pose_rank < POSE_RANK:
        yield f"the motion field has rank {pose_rank} of {POSE_RANK} in every slice: no slice fixes a pose"


def _remarks(
    model: RodModel, twins: Iterable[Symmetry], linear_rank: int, quality: tuple[SliceQuality, ...]
) -> Iterator[str]:
    if len(model) > MAX_RODS_LISTED:
        yield f"{len(model)} rods: sets are listed among the first {MAX_RODS_LISTED} only, symmetries not at all"
    if len(model) < LEAST_RODS:
        yield f"{len(model)} rods: poses with labels only; without, three spots always fit, and {LEAST_RODS} are needed"
    for i, j in coincident_pairs(model):
        yield f"rods {model.ids[i]} and {model.ids[j]} lie on one line, one over the other: written twice?"
    for twin in twins:
        yield f"{_in_words(twin)}; {_consequence(model, twin)}"
    most = max((row.rods_seen for row in quality), default=0)
    if most >= REDUNDANT_RODS and linear_rank < LINEAR_RANK:
        rank = f"rank {linear_rank} of {LINEAR_RANK}"
        yield f"the linear system has {rank} in every slice: alone it gives neither pose nor scales"
    if MIN_RODS_SEEN <= most < REDUNDANT_RODS:
        yield f"no slice cuts more than {most} rods: wrong matches can fit as well as right ones"
    best = quality[0].with_tolerance if quality else None
    if best and best.rotation_deg > WEAK_ROTATION_DEG:
        yield f"weak geometry: rotation is known to {best.rotation_deg:.1f} deg only, even where {most} rods are seen"
    if not model.tolerances.any():
        yield "no tolerance written: poses will claim too much if the rods are not exactly where the file says"


def _in_words(twin: Symmetry) -> str:
    axis = ", ".join(f"{component:.2f}" for component in twin.axis.round(2) + 0.0)
    how = "exactly" if twin.deviation_mm < 1e-6 else f"to {twin.deviation_mm:.2g} mm"
    return f"a turn of {twin.angle_deg:.1f} deg about [{axis}] maps the frame onto itself {how}"


def _consequence(model: RodModel, twin: Symmetry) -> str:
    if settled_by_mount(model, twin):
        return "the mount tells the two poses apart"
    if model.mount:
        return f"the mount's {model.mount.max_angle_deg:g} deg leave poses that are ambiguous"
    return "without a mount every pose is ambiguous"


def _named(model: RodModel, found: tuple[tuple[int, ...], ...]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(model.ids[i] for i in group) for group in found)
