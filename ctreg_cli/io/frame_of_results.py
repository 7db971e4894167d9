"""The frame that results were made with, as far as it can be found."""

from __future__ import annotations

from ctreg_cli.errors import InputError
from ctreg_cli.io.results_document import ResultsDocument
from ctreg_cli.io.rod_file import load_rod_model, shipped_frames
from ctreg_cli.rods import RodModel


def frame_of_results(document: ResultsDocument, given: str | None) -> RodModel | None:
    """The frame the user gave, else the shipped one of the same name and content, else None.

    Raises:
        RodModelError: the frame file is wrong.
        InputError: it is another one than the results were made with.
    """
    if given is None:
        if document.model_name not in shipped_frames():
            return None
        shipped = load_rod_model(document.model_name)
        return shipped if shipped.sha256 == document.model_sha256 else None
    model = load_rod_model(given)
    if document.model_sha256 and model.sha256 != document.model_sha256:
        raise InputError(
            f"{given}: {document.name} was made with another frame file ({document.model_name}); "
            "give the one it was made with"
        )
    return model
