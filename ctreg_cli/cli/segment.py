"""``ctreg segment``: the spots of every slice."""

from __future__ import annotations

from ctreg_cli.cli import options as opt


def segment(
    inputs: opt.Inputs,
    output: opt.Outputs = None,
    model: opt.ModelForSpots = None,
    polarity: opt.PolarityChoice = opt.Polarity.bright,
    series: opt.SeriesNumber = None,
    spot_sd: opt.SpotSd = None,
    overlay: opt.OverlayFolder = None,
    with_uids: opt.WithUids = False,
    strict: opt.Strict = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Find the bright spots of every slice, with the accuracy of their centres.

    A slice without spots is a row with empty cells. JSON outputs also hold the slice's patient geometry and the
    candidates left out, with the reason.

    \b
    Examples:
      ctreg segment slices/ -o spots.csv --overlay pictures/
      ctreg segment slices/ -m frame.yaml -v -o spots.json
      ctreg segment slices/ -o - | ctreg pose - -m frame.yaml
    """
    import sys
    from dataclasses import asdict

    from ctreg_cli.cli.console import Talk, counted
    from ctreg_cli.cli.run import Watched, close, consume, open_inputs
    from ctreg_cli.cli.summary import SpotTally
    from ctreg_cli.imaging.segmentation import SegmentationOptions
    from ctreg_cli.imaging.spot_slice import SpotSlice
    from ctreg_cli.io.rod_file import load_rod_model
    from ctreg_cli.io.sinks import check_outputs, open_sinks
    from ctreg_cli.io.spots_file import numbered, spots_encoding
    from ctreg_cli.pipeline import expecting
    from ctreg_cli.pipeline import segment as segment_slices

    outputs = check_outputs(output, inputs)
    talk = Talk(quiet=quiet, verbose=verbose, outputs=outputs)
    source = open_inputs(inputs, talk, series=series, spot_sd_px=spot_sd)
    segmentation = SegmentationOptions(polarity=polarity.value)
    if model is not None:
        segmentation = expecting(load_rod_model(model), segmentation)
    overlays = None
    if overlay:
        from ctreg_cli.cli.overlays import OverlayWriter

        overlays = OverlayWriter(overlay, source, inputs)
    encoding = spots_encoding(options={"command": "segment", **asdict(segmentation)}, with_uids=with_uids)
    sinks = open_sinks(outputs, encoding, sys.stdout)
    watched, tally = Watched(source, talk), SpotTally()

    def on_result(spot_slice: SpotSlice) -> None:
        tally.add(spot_slice)
        slice_ = watched.answered()
        index = spot_slice.index or 0
        if overlays and slice_:
            overlays.draw_spots(slice_, spot_slice, index)
        left_out = f"; left out: {counted(n)}" if (n := spot_slice.spots.n_rejected) else ""
        talk.explain(f"slice {index} ({spot_slice.info.source}): {len(spot_slice.spots)} spots{left_out}")

    results = numbered(segment_slices(watched, segmentation))
    consume(results, sinks, on_result, talk, total=len(source), what="segment")
    talk.table(tally.rows())
    close(n_good=sum(map(bool, tally.counts)), n_failed=tally.n_unreadable, strict=strict)
