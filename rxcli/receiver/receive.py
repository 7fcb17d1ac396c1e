"""The receiver: `receive_frame` reads as the block diagram.

`search` finds the screen, its camera and its clock, `still` alternates light model and detection, and `clip` carries
knowledge from frame to frame.
"""

from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import chain
from typing import Any

from rxcli.numerics import one_blas_thread
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.decode import assemble
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.in_common import named
from rxcli.receiver.frame.passes import Reception, headerless, soft_bits
from rxcli.receiver.frame.result import Failure, Received, failed, is_received
from rxcli.receiver.plane import orientation
from rxcli.receiver.plane.colour import in_one_mix
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import Found, search
from rxcli.receiver.search.cameras import UNKNOWN, known_camera
from rxcli.receiver.search.cut import cut_packets
from rxcli.receiver.search.evidence import USUAL_COLUMNS
from rxcli.receiver.search.framing import framing_of
from rxcli.receiver.search.outlines import may_be_turned, no_screen, proposed_screens, too_small
from rxcli.receiver.search.propose import nearest_screen
from rxcli.receiver.search.refusal import likeliest_reason, other_than_stated, ruled_out
from rxcli.receiver.still import apply_autoencoder, decode_photograph
from rxcli.receiver.sync import clock as sync
from rxcli.types import Frame, FrameResult, FrameSoftBits, OnTaps, Reason, Remark


def receive(frames: Iterable[Frame], options: ReceiverOptions, on_taps: OnTaps | None = None) -> Iterator[FrameResult]:
    """Receive the frames of one source; yields one result per frame, in order.

    Results of a clip are delayed by some frames, because a packet is reported in the last frame that shows it.

    Args:
        frames: of one source.
        options: of the receiver.
        on_taps: is given the arrays at the stage boundaries of every frame that was received.
    """
    options = _in_total_order(options)
    with closing(_iterator(frames)) as source:
        frame_0 = next(source, None)
        if frame_0 is None:
            return
        try:
            frame_1 = next(source, None)
        except Exception:
            yield receive_frame(frame_0, options, on_taps)
            raise
        if frame_1 is None:
            yield receive_frame(frame_0, options, on_taps)
            return
        from rxcli.receiver.clip import receive_clip

        for received in receive_clip(in_one_mix(chain((frame_0, frame_1), source)), options, on_taps):
            result = named(received, options)
            yield result.with_columns_mirrored() if options.mirrored else result


def _iterator(frames: Iterable[Frame]) -> Generator[Frame, None, None]:
    """The frames as a generator, whose end also ends theirs: a file is closed when reception is left early."""
    yield from frames


def _in_total_order(options: ReceiverOptions) -> ReceiverOptions:
    """Sort the profiles, so that a result does not depend on their order."""
    screens = sorted(options.screens, key=lambda s: (s.columns, -s.slot_rate_hz, s.packet_slots, s.name))
    cameras = options.cameras if options.force_camera else tuple(sorted(options.cameras, key=lambda c: c.name))
    return replace(options, screens=tuple(screens), cameras=cameras)


def receive_frame(frame: Frame, options: ReceiverOptions, on_taps: OnTaps | None = None) -> FrameResult:
    """Receive one frame as a photograph; see `receive`."""
    cache, in_order = FrameCache(frame), _in_total_order(options)
    if (reason := ruled_out(cache, options)) is not None:
        result = failed(FrameResult(frame.source, frame.index, frame.time_s, "ok"), Failure(reason, "no_screen"))
        return replace(result, remarks=(reason, Remark("not_searched")))
    with one_blas_thread():
        cache = cache.in_blinking_colours()
        received = _receive_either_way(cache, in_order)
        soft = _with_cut_packets(cache, received, in_order)
    result = _without_unlikely_screen(received.result, soft)
    remarks, skipped = _with_part_in_view(result.remarks, soft), result.skipped
    n_left = sum(step.fate == "not tried" for step in result.search)
    if n_left and not received.n_believable:
        remarks, skipped = (*remarks, Remark("not_tried", {"n": n_left})), {**skipped, "unlikely": n_left}
    received = received._replace(result=replace(result, soft_bits=soft, remarks=remarks, skipped=skipped))
    if on_taps is not None and received.taps:
        on_taps(frame.source, frame.index, received.taps)
    claims = ", ".join(frame.metadata.not_believed) if received.result.packets else ""
    result = received.with_remark(Remark("not_believed", {"claims": claims}) if claims else None).result
    if result.status == "no_signal" and result.remarks and len(options.screens) == 1:
        tried = Remark("one_screen_tried", {"screen": options.screens[0].name})
        result = replace(result, remarks=(*result.remarks, tried))
    result = named(replace(result, timing_ms=cache.timer.total()), options)
    if options.mirrored:
        return result.with_columns_mirrored()
    return replace(result, mirrored=None if frame.metadata.names_front_camera else False)


def _receive_either_way(cache: FrameCache, options: ReceiverOptions) -> Received:
    """Receive a frame as it is stored; without packets, also turned by 90 degrees if its columns lie along its rows."""
    frame, asks_for_turn = cache.frame, cache.frame.metadata.orientation in orientation.PORTRAIT
    upright = cache.with_metadata(replace(frame.metadata, orientation=1)) if asks_for_turn else cache
    received = _receive_still(upright, options)
    if received.n_believable:
        reason: Reason = "upside_down" if _is_reversed(received.result) else "as_stored"
        return received.with_remark(Remark(reason) if reason == "upside_down" or asks_for_turn else None)
    if options.corners is not None or received.result.reason == "steady_light":
        return received
    attempts = []
    for quarter_turns in orientation.QUARTER_TURNS if may_be_turned(upright, options) else ():
        back = orientation.turned_frame(frame, quarter_turns)
        attempt = _receive_still(FrameCache(back, cache.timer).in_blinking_colours(), options)
        result = orientation.as_stored(back, attempt.result, quarter_turns)
        if not _gives_few(result):
            rank = not _is_reversed(result), attempt.n_believable, quarter_turns
            attempts.append((rank, attempt._replace(result=result)))
        elif known_camera(frame, options) is None:
            break  # An estimated camera is read in either direction.
    if attempts:
        (*_, quarter_turns), best = max(attempts, key=lambda attempt: attempt[0])
        return best.with_remark(Remark("turned_counterclockwise" if quarter_turns == 1 else "turned_clockwise"))
    remarks = likeliest_reason(cache, received.result, options)
    if remarks and remarks[0].reason in ("portrait", "on_its_side"):
        # Packets that are not believable are none then.
        nothing = FrameResult(frame.source, frame.index, frame.time_s, "ok")
        return Received(failed(nothing, Failure(remarks[0], "no_screen")), {})
    return received.with_remarks(*remarks)


def _is_reversed(result: FrameResult) -> bool:
    return result.estimated.get("readout_reversed", (0.0, 0.0))[0] > 0


def _gives_few(result: FrameResult) -> bool:
    """Whether less than half of the lit columns gave a packet."""
    lit = [column for column in result.columns if column.status != "dark"]
    n_received = sum(any(is_received(packet, result) for packet in column.packets) for column in lit)
    return 2 * n_received < max(len(lit), 1)


def _receive_still(cache: FrameCache, options: ReceiverOptions) -> Received:
    """Receive every screen in a frame; the one with the most packets comes first."""
    nothing = FrameResult(cache.frame.source, cache.frame.index, cache.frame.time_s, "ok")
    screens = proposed_screens(cache, options)
    if isinstance(screens, Failure):
        return Received(failed(nothing, screens), {})
    received = [_receive_screen(nothing, cache, outlines, options) for outlines in screens]
    clearest = received[0].result
    if not screens[0][0].stands_out and not clearest.packets and clearest.reason != "steady_light":
        return Received(replace(failed(nothing, no_screen(cache)), search=clearest.search), {})
    best, *less = sorted(received, key=lambda screen: -screen.n_believable)
    other_screens = tuple(screen.result for screen in less if screen.result.packets)
    return best._replace(result=replace(best.result, other_screens=other_screens))


def _receive_screen(
    nothing: FrameResult, cache: FrameCache, outlines: list[Outline], options: ReceiverOptions
) -> Received:
    """Receive one screen; `nothing` is the result without any."""
    frame, timer = cache.frame, cache.timer
    # Search: where the columns are, what a row is in time, which screen and clock.
    found = search(cache, options, outlines=outlines, may_doubt=True)
    if isinstance(found, Failure):
        return Received(failed(nothing, found), {})
    outline, context, acquisition = found.outline, found.best.context, found.best.acquisition
    camera = context.camera
    # Channel and decode, in turn: slots to symbols, and symbols to the picture.
    with timer("detect"):
        reception = decode_photograph(acquisition, options.skip, found.best.reception)
        no_header, framing = headerless(reception), framing_of(acquisition, reception, found.screens, context)
    with timer("denoise"):
        reception, denoised, report = apply_autoencoder(acquisition, reception, options)
    # Packets, with the probability that they are right.
    columns = assemble.column_results(
        assemble.FrameColumns(
            reception.clock, reception.snr, no_header, options.min_confidence, outline.certainty, framing.bursts
        ),
        reception.posteriors,
        reception.n_observed,
        reception.confidence_features(reception.posteriors, denoised),
        denoised,
    )
    if camera.reversed:
        columns = tuple(assemble.in_stored_rows(column, frame.height) for column in columns)
    tails = {"spread_tails": reception.model.tails} if reception.model.tails[0] else {}
    result = replace(
        nothing,
        status=assemble.frame_status(columns),
        **outline.result_fields,
        **{**context.result_fields, "estimated": {**context.result_fields["estimated"], **tails}},
        search=tuple(tried.step for tried in found.tried),
        screen_profile=acquisition.variant(sync.likely_repeats(reception.clock, acquisition.repeats)).name,
        columns=columns,
        denoiser=report,
        skipped=reception.skipped,
        soft_bits=soft_bits(frame, acquisition.screen, reception, no_header, denoised) if options.soft_bits else None,
    )
    if result.status == "no_signal":
        remark = too_small(context, acquisition.screen) or assemble.why_no_packet(columns)
        result = replace(result, remarks=(remark,))
    elif outline.column_offset is None:
        leftmost = next((column.column for column in columns if column.packets), 0)
        facts = {"column": leftmost, "certainty": outline.certainty}
        result = replace(result, remarks=(Remark("column_numbers", facts),))
    received = Received(result, _taps(found, reception))
    return received.with_remark(other_than_stated(cache.frame, options, found, received))


def _with_cut_packets(cache: FrameCache, received: Received, options: ReceiverOptions) -> FrameSoftBits | None:
    """The soft bits of a result; without a believable packet, those of less than a packet come first."""
    result, known = received.result, known_camera(cache.frame, options)
    own, is_steady = result.soft_bits, result.reason == "steady_light"
    if not options.soft_bits or received.n_believable or is_steady or isinstance(known, Failure):
        return own
    screens = proposed_screens(cache, options)
    if isinstance(screens, Failure):
        return own
    families = list({own.family: own for own in reversed(screens[0]) if not own.rival_odds}.values())
    context = FrameContext(cache, screens[0][0].corners, known or UNKNOWN, _of_columns(result, options))
    cut = cut_packets(context, families)
    likeliest, *less_likely = (*cut, *([own] if own else ())) or (None,)
    return None if likeliest is None else replace(likeliest, alternatives=tuple(less_likely))


def _without_unlikely_screen(result: FrameResult, soft: FrameSoftBits | None) -> FrameResult:
    """The result without a screen whose packets did not show, if the light is rather a part of another's."""
    own = result.soft_bits
    if result.status != "no_signal" or own is None or soft is None or soft.llr.shape[1] == own.llr.shape[1]:
        return result
    return replace(result, columns=(), screen_profile=None, remarks=(Remark("no_headers"),))


def _with_part_in_view(remarks: tuple[Remark, ...], soft: FrameSoftBits | None) -> tuple[Remark, ...]:
    """The remarks, with the share of a packet in view as the reason where no header was found."""
    if soft is None:
        return remarks
    part = Remark("part_in_view", {"share": float(soft.llr.any(axis=(0, 2, 3)).mean())})
    return tuple(part if remark.reason == "no_headers" else remark for remark in remarks)


def _of_columns(result: FrameResult, options: ReceiverOptions) -> tuple[ScreenProfile, ...]:
    """Screens with the columns of a result."""
    n_columns = nearest_screen(options.screens, len(result.columns) or USUAL_COLUMNS).columns
    return tuple(screen for screen in options.screens if screen.columns == n_columns)


def _taps(found: Found, reception: Reception) -> dict[str, Any]:
    """Arrays at the stage boundaries, by stage."""
    initial = found.best.reception
    return {
        "geometry.corners": found.outline.corners,
        "geometry.sampled_corners": found.best.context.sampled_corners,
        "sampling": found.best.acquisition.profiles,
        "clock": reception.clock,
        "samples": initial.samples,
        "channel.initial_llr": initial.llr,
        "channel.llr": reception.llr,
        "detect": reception.posteriors,
    }
