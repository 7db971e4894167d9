"""ITK transform files (``.tfm``), which SimpleITK, ANTs, elastix and 3D Slicer read."""

from __future__ import annotations

from ctreg_cli.geometry.pose import inverse
from ctreg_cli.interop.selection import Content
from ctreg_cli.io.results_document import SliceRecord


def tfm(content: Content, record: SliceRecord) -> bytes:
    """The pose of one slice as an affine transform, in **resampling direction**.

    ITK keeps the map from the fixed (reference) to the moving space, which is the inverse of the pose: points of the
    slice (or patient, LPS) go to model coordinates. 3D Slicer turns it round again on loading, so that a model put
    under the transform stands where the frame is.
    """
    T = inverse(content.pose(record))
    parameters = [*T[:3, :3].ravel().tolist(), *T[:3, 3].tolist()]
    space = "patient (LPS)" if content.space == "patient" else "slice"
    lines = [
        "#Insight Transform File V1.0",
        f"# maps {space} coordinates to model coordinates, mm: ITK's direction of resampling, the inverse of the pose",
        f"# slice {record.index}",
        "#Transform 0",
        "Transform: AffineTransform_double_3_3",
        f"Parameters: {' '.join(f'{number:.17g}' for number in parameters)}",
        "FixedParameters: 0 0 0",
    ]
    return ("\n".join(lines) + "\n").encode()
