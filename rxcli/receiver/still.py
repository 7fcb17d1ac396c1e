"""Reception of a still from its clock: light model and detection in turn. Part of the wiring."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import ReceiverError
from rxcli.numerics import mean_of_valid
from rxcli.options import ReceiverOptions
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.receiver import channel
from rxcli.receiver.channel import denoise, ratios
from rxcli.receiver.decode import assemble, detect, survivors
from rxcli.receiver.decode.settings import QUICK_SURVIVORS
from rxcli.receiver.decode.settings import SURVIVORS as survivor_settings
from rxcli.receiver.frame.acquisition import Acquisition, noise_of
from rxcli.receiver.frame.passes import Reception, dark_columns, packet_llr
from rxcli.receiver.frame.settings import SETTINGS, STILL
from rxcli.receiver.light import (
    LONG_EXPOSURE_SLOTS,
    MAX_EXPOSURE_SLOTS,
    Crosstalk,
    Exposure,
    NoiseModel,
    dark_sigma,
)
from rxcli.receiver.sync import clock as sync
from rxcli.receiver.sync.settings import SETTINGS as sync_settings
from rxcli.types import (
    BoolArray,
    BurstPosteriors,
    BurstSamples,
    Clock,
    Denoiser,
    Float32Array,
    FloatArray,
    SlotSamples,
)


def decode_photograph(acquisition: Acquisition, skip: frozenset[str], initial: Reception) -> Reception:
    """Decode a photograph from its initial pass; without packets there, further passes are skipped.

    Args:
        acquisition: the clock and the row profiles.
        skip: enabled shortcuts, see `rxcli.options.SKIPS`.
        initial: the initial pass.
    """
    if "no_packets" in skip and not _may_show_packets(initial):
        return replace(initial, skipped={"no_packets": initial.snr.shape[0]})
    return decode(acquisition, skip, initial)


def _may_show_packets(initial: Reception) -> bool:
    """Whether the initial pass may contain a packet."""
    if (initial.packet_confidence[initial.is_complete] > STILL.doubtful).any():
        return True
    return packet_llr(initial) + max(float(initial.header_llr.sum()), 0.0) > SETTINGS.min_packets_llr


def decode(
    acquisition: Acquisition,
    skip: frozenset[str],
    initial: Reception,
    *,
    adds_up: bool = False,
    keeps_weights: bool = False,
) -> Reception:
    """Make a further pass over doubtful columns, which uses more of the light and replaces the result.

    Args:
        acquisition: the clock and the row profiles.
        skip: enabled shortcuts, see `rxcli.options.SKIPS`.
        initial: the initial pass.
        adds_up: whether the slots are to be added to those of other frames.
        keeps_weights: whether the weights of the initial pass are known.
    """
    reception = initial = _with_tails(acquisition, initial)
    n_columns = len(initial.snr)
    # The initial pass is too sure where samples show more than two slots.
    is_short = adds_up or initial.model.exposure.isi_memory == 1
    candidates = doubtful_columns(initial) if "certain_columns" in skip and is_short else np.arange(n_columns)
    lit = candidates[~dark_columns(initial.snr)[candidates]] if "dark_columns" in skip else candidates
    skipped = {"certain_columns": n_columns - candidates.size, "dark_columns": candidates.size - lit.size}
    # Joint detection gives no slots by themselves, and developing mixes rows that are few per slot.
    by_slot = adds_up or initial.clock.rows_per_slot < STILL.min_joint_rows
    # Noise of rows is estimated from the slots: again once these are better.
    for _ in range(1 + ((by_slot or acquisition.profiles.has_row_noise) and not initial.is_long)):
        if not lit.size:
            break
        if by_slot and not initial.is_long:
            reception, *_ = without_row_noise(acquisition, reception, lit)
        else:
            reception = follow_picture(acquisition, reception, lit, keeps_weights=keeps_weights)
        lit = np.intersect1d(lit, doubtful_columns(reception))
    return replace(reception, skipped={name: count for name, count in skipped.items() if count})


def _with_tails(acquisition: Acquisition, initial: Reception) -> Reception:
    """The initial pass with crosstalk as decided slots show it, where that is wider than in the screen's profile."""
    if initial.is_long:
        return initial
    lit, columns = initial.clock.on_grid(initial.posteriors.lit), np.arange(len(initial.snr))
    trust, light_spread = initial.best_confidence(), acquisition.screen.light_spread
    tails = channel.estimate_tails(initial.samples, initial.clock, initial.model, lit, trust, light_spread)
    if not tails[0]:
        return initial
    model = initial.model.with_tails(light_spread, tails)
    found = channel.slot_likelihoods(initial.samples, initial.clock, model, lit, columns, is_initial=True)
    return replace(_with_slots(initial, columns, found), model=model)


def initial_pass(acquisition: Acquisition, room_light: float = 1.0) -> Reception:
    """Make a pass over strips binned in pairs, from an initial estimate of the slots.

    Args:
        acquisition: the clock and the row profiles.
        room_light: that is assumed where no header is in view, relative to its estimate.
    """
    acquisition = replace(acquisition, profiles=acquisition.binned)
    clock = acquisition.clock
    if clock.exposure_slots > LONG_EXPOSURE_SLOTS:
        return _joint_initial_pass(acquisition)
    # Demosaicing and denoising mix neighbouring rows: with few rows per slot this widens the effective exposure.
    exposure_slots = float(np.hypot(clock.exposure_slots, 1 / clock.rows_per_slot))
    clock = replace(clock, exposure_slots=exposure_slots)
    samples = sync.sample_slots(acquisition.profiles, clock, STILL.coarse_samples)
    model = _light_model(acquisition, clock, samples, room_light)
    contrast = sync.contrast(samples.light, samples.valid, STILL.coarse_samples, model.noise.sigma)
    llr = channel.initial_llr(*contrast, model.exposure)
    clock = in_bursts(acquisition, clock, llr)
    lit = clock.on_grid(detected(llr, clock).lit)
    columns = np.arange(samples.light.shape[0])
    likelihoods = channel.slot_likelihoods(samples, clock, model, lit, columns, is_initial=True)
    clock = in_bursts(acquisition, clock, likelihoods.llr)
    clock = sync.corrected(clock, likelihoods.timing)
    posteriors = detected(likelihoods.llr, clock)
    joint = np.zeros(columns.size, bool)
    return Reception(clock, samples, contrast, posteriors, likelihoods.snr, model, likelihoods.llr, joint)


def detected_on(reception: Reception, clock: Clock) -> Reception:
    """The initial pass with its slots at other places in their packets."""
    return replace(reception, clock=clock, posteriors=detected(reception.llr, clock))


def slots_of_any_kind(acquisition: Acquisition, clocks: Sequence[Clock]) -> list[tuple[Float32Array, float]]:
    """Slots and picture on clocks of one shape, whatever the slots send, whose payload is all that is in view.

    Returns:
        For each clock, the probability that its slots are lit (C, slots of a packet), and the log evidence.
    """
    profiles, columns = acquisition.binned, np.arange(len(acquisition.profiles.light))
    parts = []
    for clock in clocks:
        samples = sync.sample_slots(profiles, clock, STILL.coarse_samples)
        model = _light_model(replace(acquisition, profiles=profiles), clock, samples)
        by_start = sync.sample_slots(profiles, ratios.by_start(clock), STILL.coarse_samples)
        parts.append(ratios.burst_samples(by_start, clock, model, columns))
    lit, evidence = survivors.detect_free(survivors.side_by_side(parts), QUICK_SURVIVORS)
    by_clock = evidence.reshape(len(clocks), -1).sum(axis=1).tolist()
    return list(zip(lit.reshape(len(clocks), columns.size, -1), by_clock, strict=True))


def _joint_initial_pass(acquisition: Acquisition) -> Reception:
    """Make a pass that detects slots and picture jointly: first every copy by itself, then the copies of bursts."""
    clock = acquisition.clock
    samples = sync.sample_slots(acquisition.profiles, clock, STILL.coarse_samples)
    model = _light_model(acquisition, clock, samples)
    valid = samples.light[samples.valid > 0]
    black_level = STILL.dark_share * float(np.percentile(valid, STILL.dark_percent)) if valid.size else 0.0
    model = replace(model, black_level=black_level)
    columns = np.arange(len(samples.light))
    by_start = sync.sample_slots(acquisition.profiles, ratios.by_start(clock), STILL.coarse_samples)
    single = clock.by_copy
    alone = survivors.detect(ratios.burst_samples(by_start, single, model, columns), QUICK_SURVIVORS)
    lit, some = single.on_grid(alone.lit), _some(columns)

    def of_way(clock: Clock) -> BurstSamples:
        return _of_weights(ratios.burst_samples(by_start, clock, model, some, lit), alone.w_log_prob[some])

    llr = channel.llr_of(lit)
    ways = _ways_by_evidence(acquisition, clock, llr, of_way)
    (clock, _), by_evidence = ways[0], [(way.burst, gain) for way, gain in ways]
    bursts = _with_weights(ratios.burst_samples(by_start, clock, model, columns, lit), alone.w_log_prob)
    posteriors, free = survivors.detect_against_free(bursts, QUICK_SURVIVORS)
    contrast = sync.contrast(samples.light, samples.valid, STILL.coarse_samples, model.noise.sigma)
    snr = _joint_snr(model.over_black(samples), samples, model, clock)
    # Noise is no evidence, and leaves most symbols open.
    observed = assemble.slots_observed(samples, clock)[..., PREAMBLE_SLOTS:] > 0
    is_shown = observed.reshape(*posteriors.log_prob.shape, -1).all(axis=-1)
    is_decided = (posteriors.log_prob > np.log(0.5)) & is_shown
    share = is_decided.sum(axis=(0, 2)) / np.maximum(is_shown.sum(axis=(0, 2)), 1) * ~dark_columns(snr)
    posteriors = replace(posteriors, log_evidence=(posteriors.log_evidence - free) * share)
    joint = np.ones(len(columns), bool)
    found = Reception(clock, samples, contrast, posteriors, snr, model, llr, joint, is_long=True)
    return replace(found, bursts_by_evidence=by_evidence)


def detect_jointly(
    acquisition: Acquisition,
    model: channel.ObservationModel,
    w_log_prob: FloatArray,
    lit: Float32Array | None,
    columns: NDArray[np.int64] | None = None,
) -> tuple[BurstPosteriors, Float32Array]:
    """Detect slots and picture of some columns or all, the copies as the clock assigns them.

    Args:
        acquisition: the clock, and profiles with a level where the picture is known.
        model: of samples on the coarse grid.
        w_log_prob: (C, 9) log probability of the columns' weights.
        lit: (C, N) probability that each slot is lit, for the light of neighbours; None: unknown.
        columns: numbers of the columns to detect; None: all.

    Returns:
        The posteriors of these columns, and (C, N) squared contrast over variance of all.
    """
    samples, bursts = _joint_samples(acquisition, model, w_log_prob, lit, columns)
    found = survivors.detect(bursts, QUICK_SURVIVORS if lit is None else survivor_settings)
    return found, _joint_snr(model.over_black(samples), samples, model, acquisition.clock)


def _joint_samples(
    acquisition: Acquisition,
    model: channel.ObservationModel,
    w_log_prob: FloatArray,
    lit: Float32Array | None,
    columns: NDArray[np.int64] | None = None,
) -> tuple[SlotSamples, BurstSamples]:
    clock = acquisition.clock
    columns = np.arange(len(acquisition.profiles.light)) if columns is None else columns
    samples = sync.sample_slots(acquisition.profiles, ratios.by_start(clock), STILL.coarse_samples)
    bursts = ratios.burst_samples(samples, clock, model, columns, lit)
    return samples, _with_weights(bursts, w_log_prob[columns], are_open=True)


def _with_weights(
    bursts: BurstSamples, w_log_prob: FloatArray, *, are_known: bool = False, are_open: bool = False
) -> BurstSamples:
    """Bursts whose paths begin with the weights' log probability (C, 9); bursts in which these show may find others.

    Paths that see nothing of a packet's start would keep the weights of fewest words, unless the picture is known.
    """
    is_open = (survivors.shows_weight(bursts)[..., None] | are_open) & (not are_known)
    log_prior = np.maximum(w_log_prob, np.where(is_open, STILL.min_weight_log_prior, STILL.no_weight))
    log_prior = log_prior / bursts.n_bursts
    return replace(bursts, w_log_prior=log_prior.reshape(-1, len(WEIGHTS)))


def lateness(acquisition: Acquisition, model: channel.ObservationModel, w_log_prob: FloatArray, step: float) -> float:
    """Lateness of the clock, slots, at most `step`, by the evidence of every copy by itself on a clock to each side."""
    clock, parts = acquisition.clock.by_copy, []
    for late in (-step, 0.0, step):
        moved = replace(clock, row0=clock.row0 - late * clock.rows_per_slot)
        parts.append(_joint_samples(replace(acquisition, clock=moved), model, w_log_prob, None)[1])
    early, here, late = survivors.log_evidence_of(parts, QUICK_SURVIVORS).sum(axis=1).tolist()
    curvature = early + late - 2 * here
    best = (early - late) / (2 * curvature) if curvature < 0 else np.sign(late - early)
    return step * float(np.clip(best, -1, 1))


def _joint_snr(
    light: Float32Array, samples: SlotSamples, model: channel.ObservationModel, clock: Clock
) -> Float32Array:
    """(C, N) squared contrast of a slot over its noise, of the light on average."""
    q = samples.samples_per_slot
    mean = mean_of_valid(light, samples.valid, SLOTS_PER_SYMBOL * q)
    contrast = 2 * np.maximum(mean, 0) * model.crosstalk.own / np.float32(max(clock.exposure_slots, 1.0))
    ratio = contrast**2 / model.noise.variance(mean) * samples.valid
    return np.asarray(ratio[..., q // 2 :: q].sum(axis=1) * np.float32(survivor_settings.information_of(q)))


def follow_picture(
    acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64], *, keeps_weights: bool = False
) -> Reception:
    """Detect slots and picture of some columns jointly, with all strips, given the slots decided so far."""
    reception = _refined(acquisition, reception, columns) if reception.is_long else reception
    clock = reception.clock
    q = int(np.clip(clock.rows_per_slot / STILL.min_sample_rows, STILL.coarse_samples, denoise.SAMPLES_PER_SLOT))
    samples, model = _view(acquisition, reception, np.arange(len(reception.snr)), q, ratios.by_start(clock))
    lit = clock.on_grid(reception.posteriors.lit)
    if acquisition.profiles.has_row_noise and not reception.is_long:
        by_start = replace(model, exposure=Exposure.by_start(clock.exposure_slots, q))
        whole = by_start.expected(lit, clock, np.arange(len(lit))).whole
        samples = denoise.remove_row_noise(samples, whole, model)
    # A local mean would follow the slots.
    samples = replace(samples, level=mean_of_valid(samples.light, samples.valid, samples.light.shape[2]))
    bursts = ratios.burst_samples(samples, clock, model, columns, lit)
    bursts = _with_weights(bursts, reception.posteriors.w_log_prob[columns], are_known=keeps_weights)
    # Of long exposures columns are too rarely right to show what they have in common.
    found = survivors.detect(bursts, has_common_weights=not reception.is_long)
    header_llr, log_prob = reception.posteriors.header_llr[:, columns], found.log_prob
    log_evidence = reception.posteriors.log_evidence[columns]
    if reception.is_long:  # Where arbitrary slots explain a column as well, it may have no packets.
        log_prob = log_prob - np.logaddexp(0, -log_evidence)[None, :, None] / log_prob.shape[2]
    found = replace(found, header_llr=header_llr, log_evidence=log_evidence, log_prob=log_prob)
    joint = reception.joint.copy()
    joint[columns] = True
    return replace(reception, posteriors=reception.posteriors.with_columns(columns, found), joint=joint)


def _some(columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """A few of the columns, spread over all."""
    n_columns = min(STILL.n_judged_columns, columns.size)
    return np.asarray(columns[np.linspace(0, columns.size - 1, n_columns).round().astype(int)])


def _refined(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> Reception:
    """The reception with exposure and black level of the largest evidence in some of `columns`.

    The start of packets was found by the ends of exposures, which stay where they are.
    """
    some = _some(columns)
    weights = reception.posteriors.w_log_prob[some]
    lit = reception.clock.on_grid(reception.posteriors.lit)
    exposed = [_exposed_for(reception.clock, factor) for factor in STILL.exposure_factors]
    views = [_view(acquisition, reception, some, STILL.coarse_samples, ratios.by_start(clock)) for clock in exposed]

    def bursts(clock: Clock, number: int, level: float) -> BurstSamples:
        samples, model = views[number]
        model = replace(model, black_level=level)
        return _of_weights(ratios.burst_samples(samples, clock, model, some, lit), weights)

    def likeliest(parts: list[BurstSamples]) -> int:
        return int(survivors.log_evidence_of(parts, QUICK_SURVIVORS).sum(axis=1).argmax())

    level = reception.model.black_level
    number = likeliest([bursts(clock, number, level) for number, clock in enumerate(exposed)])
    clock = exposed[number]
    light = reception.samples.light[reception.samples.valid > 0]
    levels = [float(np.percentile(light, STILL.dark_percent)) * share for share in STILL.dark_shares]
    level = levels[likeliest([bursts(clock, number, level) for level in levels])]
    return replace(reception, clock=clock, model=replace(reception.model, black_level=level))


def _ways_by_evidence(
    acquisition: Acquisition, clock: Clock, llr: Float32Array, bursts: Callable[[Clock], BurstSamples]
) -> list[tuple[Clock, float]]:
    """Assignments of copies to bursts, likeliest first, each with its lead in the log evidence of some columns."""
    ways = [way for way, _ in sync.possible_bursts(clock, llr, acquisition.repeats)]
    if len(ways) == 1:
        return [(ways[0], 0.0)]
    by_column, most = survivors.log_evidence_of([bursts(way) for way in ways], QUICK_SURVIVORS), STILL.max_column_gain
    gains = np.clip(by_column - by_column[0], -most, most).sum(axis=1).tolist()
    return sorted(zip(ways, gains, strict=True), key=lambda way: -way[1])


def _of_weights(bursts: BurstSamples, w_log_prob: FloatArray) -> BurstSamples:
    """Bursts whose evidence is that of weights with a log probability (C, 9): they must not pay for one each."""
    return replace(bursts, w_log_prior=np.tile(w_log_prob + np.log(len(WEIGHTS)), (bursts.n_bursts, 1)))


def _exposed_for(clock: Clock, factor: float) -> Clock:
    """The clock with another exposure that ends at the same time."""
    longer = min((factor - 1) * clock.exposure_slots, MAX_EXPOSURE_SLOTS - clock.exposure_slots)
    row0 = clock.row0 + longer / 2 * clock.rows_per_slot
    return replace(clock, exposure_slots=clock.exposure_slots + longer, row0=row0)


def in_other_bursts(acquisition: Acquisition, reception: Reception) -> Iterator[tuple[Reception, float]]:
    """Receptions with the copies assigned to bursts in other ways; none if the similarity of copies leaves no doubt.

    Each comes with the log-odds by which its copies are less likely so by themselves.
    """
    if reception.is_long:
        return
    (_, log_weight), *rivals = sync.possible_bursts(reception.clock, reception.llr, acquisition.repeats)
    for clock, rival_log_weight in rivals:
        if log_weight - rival_log_weight <= sync_settings.settled_llr or not reception.is_complete.any():
            yield detected_on(reception, clock), log_weight - rival_log_weight


def as_one_column(reception: Reception) -> Reception:
    """Receive all columns as one that sends the same."""
    middle = reception.of_columns(np.array([reception.snr.shape[0] // 2]))
    return detected_on(replace(middle, llr=reception.llr.sum(axis=0, keepdims=True)), middle.clock)


def doubtful_columns(reception: Reception) -> NDArray[np.int64]:
    """Columns with a complete packet of low confidence; where no packet is complete, all columns."""
    doubtful = (reception.packet_confidence < STILL.doubtful) & (reception.is_complete | ~reception.is_complete.any())
    return np.flatnonzero(doubtful.any(axis=0))


def without_row_noise(
    acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]
) -> tuple[Reception, denoise.DenoiserInput, channel.SlotLikelihoods]:
    """Slots of some columns on the fine grid without row noise: detected, for the auto-encoder, and by themselves."""
    samples, model = _view(acquisition, reception, np.arange(len(reception.snr)), denoise.SAMPLES_PER_SLOT)
    lit = reception.clock.on_grid(reception.posteriors.lit)
    whole = model.expected(lit, reception.clock, np.arange(len(lit))).whole
    samples = denoise.remove_row_noise(samples, whole, model)
    slots = channel.slot_likelihoods(samples.of_columns(columns), reception.clock, model, lit, columns)
    by_slot = _with_slots(reception, columns, slots)
    return by_slot, by_slot.scene_of(samples, model), slots


def _with_slots(reception: Reception, columns: NDArray[np.int64], slots: channel.SlotLikelihoods) -> Reception:
    """Replace the slots of some columns and detect their words again."""
    llr, snr = reception.llr.copy(), reception.snr.copy()
    llr[columns], snr[columns] = slots.llr, slots.snr
    found = detected(slots.llr, reception.clock, words=slots.words)
    posteriors = reception.posteriors.with_columns(columns, found)
    joint = reception.joint.copy()
    joint[columns] = False
    return replace(reception, llr=llr, snr=snr, posteriors=posteriors, joint=joint)


def _view(
    acquisition: Acquisition,
    reception: Reception,
    columns: NDArray[np.int64],
    samples_per_slot: int,
    own_clock: Clock | None = None,
) -> tuple[SlotSamples, channel.ObservationModel]:
    """Sample all strips of some columns and adapt the light model of the initial pass to them."""
    clock, binned = reception.clock, reception.samples
    samples = sync.sample_slots(acquisition.profiles, own_clock or clock, samples_per_slot, columns)
    n_strips = samples.light.shape[1]
    # Ratio of the pixels per sample in the initial pass to those here.
    larger = n_strips / binned.light.shape[1]
    larger *= _rows_per_sample(clock, binned.samples_per_slot) / _rows_per_sample(clock, samples_per_slot)
    model = replace(
        reception.model,
        noise=reception.model.noise.of_mean(1 / larger),
        crosstalk=Crosstalk.of(n_strips, acquisition.screen.light_spread, reception.model.tails[0]),
        exposure=Exposure.of(clock.exposure_slots, samples_per_slot),
    )
    return samples, model


def apply_autoencoder(
    acquisition: Acquisition, reception: Reception, options: ReceiverOptions
) -> tuple[Reception, frozenset[int], dict[str, Any] | None]:
    """Make the last pass over doubtful columns: corrections by the auto-encoder.

    Returns:
        The reception, the columns whose corrections were kept, and the report; None if nothing was done.
    """
    n_columns = len(reception.snr)
    columns = np.arange(n_columns) if options.cae == "always" else doubtful_columns(reception)
    columns = _worth_showing(acquisition, reception, columns)
    if options.cae == "never" or columns.size == 0 or reception.is_long:
        return reception, frozenset(), None
    report: dict[str, Any] = {"model": denoise.DEFAULT_MODEL, "columns": columns.size, "kept": 0}
    by_slot, scene, slots = without_row_noise(acquisition, reception, columns)
    try:
        denoiser = options.denoiser or _denoiser()
        corrections = denoiser.slot_corrections(scene, columns)
    except ReceiverError as error:
        return reception, frozenset(), {**report, "columns": 0, "message": str(error)}
    after = _with_slots(by_slot, columns, replace(slots, llr=slots.llr + corrections))
    surest = after.best_confidence(frozenset(columns.tolist()))
    is_surer = surest > np.maximum(reception.best_confidence(), STILL.min_corrected_confidence)
    improved = columns[is_surer[columns]]
    report.update(model=denoiser.name, kept=improved.size)
    is_improved = np.zeros(n_columns, bool)
    is_improved[improved] = True
    posteriors = reception.posteriors.with_columns(improved, after.posteriors.of_columns(improved))
    # The network knows the positions of headers, so their presence is judged without it.
    posteriors = replace(posteriors, header_llr=reception.posteriors.header_llr)
    llr = np.where(is_improved[:, None], after.llr, reception.llr)
    joint = reception.joint & ~is_improved
    return replace(reception, llr=llr, posteriors=posteriors, joint=joint), frozenset(improved.tolist()), report


def _worth_showing(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """The surest of `columns`, as many as the time of the network allows."""
    n_strips = acquisition.profiles.light.shape[1]
    n_columns = max(STILL.max_network_slots // (n_strips * reception.clock.n_slots), 1)
    return np.sort(columns[np.argsort(-reception.best_confidence()[columns], kind="stable")[:n_columns]])


@lru_cache(maxsize=1)
def _denoiser() -> Denoiser:
    return denoise.load_denoiser()


def in_bursts(acquisition: Acquisition, clock: Clock, llr: Float32Array) -> Clock:
    """Assign copies to bursts by the similarity of their slots, from log-likelihood ratios (C, N)."""
    return sync.possible_bursts(clock, llr, acquisition.repeats)[0][0]


def detected(
    llr: Float32Array, clock: Clock, weights: BoolArray | None = None, words: Float32Array | None = None
) -> BurstPosteriors:
    """Detect the packets of a clock from log-likelihood ratios (C, N) of the grid; see `detect.detect`.

    `words` is (C, copies, symbols, n), see `channel.SlotLikelihoods`.
    """
    if words is not None:
        words = channel.beyond_slots(clock.added(words)[:, :, PREAMBLE_SLOTS // SLOTS_PER_SYMBOL :])
    found = detect.detect(clock.by_burst(llr), weights, words)
    free = detect.free_log_evidence(llr, found.w / SLOTS_PER_SYMBOL) + np.log(len(WEIGHTS))
    return replace(found, log_evidence=found.log_evidence - free)


def _light_model(
    acquisition: Acquisition, clock: Clock, samples: SlotSamples, room_light: float = 1.0
) -> channel.ObservationModel:
    profiles = acquisition.profiles
    rows = _rows_per_sample(clock, samples.samples_per_slot)
    min_sigma = 0.5 * noise_of(profiles) / rows**0.5
    black_level = channel.estimate_black_level(samples, clock)
    if black_level is None:
        black_level = room_light * _darkest(samples, min_sigma)
    sigma = dark_sigma(samples.light, samples.valid, black_level, min_sigma)
    return channel.ObservationModel(
        black_level=black_level,
        noise=NoiseModel(sigma**2, profiles.noise_slope / max(float(np.median(profiles.count)), 1.0) / rows),
        crosstalk=Crosstalk.of(samples.light.shape[1], acquisition.screen.light_spread),
        exposure=Exposure.of(clock.exposure_slots, samples.samples_per_slot),
    )


def _darkest(samples: SlotSamples, sigma: float) -> float:
    """The light of a dark slot where no header is in view: of what is dark in a column and in those beside it."""
    pooled, _ = sync.contrast(samples.light, samples.valid, samples.samples_per_slot, sigma)
    is_dark = np.pad(pooled < STILL.dark_contrast, ((1, 1), (0, 0)), constant_values=True)
    is_dark = is_dark[1:-1] & is_dark[:-2] & is_dark[2:]
    shown = samples.light[is_dark[:, None] & (samples.valid > 0)]
    return float(np.percentile(shown, STILL.dark_quarter)) if shown.size else 0.0


def _rows_per_sample(clock: Clock, samples_per_slot: int) -> float:
    return max(clock.rows_per_slot / samples_per_slot, 1.0)
