"""Reception of a still from its clock: light model and detection in turn. Part of the wiring."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import ReceiverError
from rxcli.options import ReceiverOptions
from rxcli.receiver import channel
from rxcli.receiver.channel import denoise
from rxcli.receiver.decode import detect
from rxcli.receiver.frame.acquisition import Acquisition, noise_of
from rxcli.receiver.frame.passes import Reception, best_log_prob, dark_columns, packet_llr, word_log_prob
from rxcli.receiver.frame.settings import SETTINGS, STILL
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, dark_sigma, slot_llr
from rxcli.receiver.sync import clock as sync
from rxcli.types import BurstPosteriors, Clock, Denoiser, Float32Array, FloatArray, SlotSamples


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
    return packet_llr(initial) + max(float(initial.posteriors.header_llr.sum()), 0.0) > SETTINGS.min_packets_llr


def decode(acquisition: Acquisition, skip: frozenset[str], initial: Reception) -> Reception:
    """Make further passes over doubtful columns.

    Each pass uses more of the light than the previous one and replaces its result.

    Args:
        acquisition: the clock and the row profiles.
        skip: enabled shortcuts, see `rxcli.options.SKIPS`.
        initial: the initial pass.
    """
    reception, n_columns = initial, len(initial.snr)
    candidates = doubtful_columns(initial) if "certain_columns" in skip else np.arange(n_columns)
    lit = candidates[~dark_columns(initial.snr)[candidates]] if "dark_columns" in skip else candidates
    skipped = {"certain_columns": n_columns - candidates.size, "dark_columns": candidates.size - lit.size}
    for run_pass in (_of_all_strips, _without_row_noise):
        columns = np.intersect1d(lit, doubtful_columns(reception)) if "certain_columns" in skip else lit
        if columns.size:
            reception = run_pass(acquisition, reception, columns)
    return replace(reception, skipped={name: count for name, count in skipped.items() if count})


def initial_pass(acquisition: Acquisition) -> Reception:
    """Make a pass over strips binned in pairs, from an initial estimate of the slots."""
    acquisition = replace(acquisition, profiles=acquisition.binned)
    clock = acquisition.clock
    # Demosaicing and denoising mix neighbouring rows: with few rows per slot this widens the effective exposure.
    exposure_slots = float(np.hypot(clock.exposure_slots, 1 / clock.rows_per_slot))
    clock = replace(clock, exposure_slots=exposure_slots)
    samples = sync.sample_slots(acquisition.profiles, clock, STILL.coarse_samples)
    model = _light_model(acquisition, clock, samples)
    contrast = sync.contrast(samples.light, samples.valid, STILL.coarse_samples, model.noise.sigma)
    metrics = channel.initial_metrics(*contrast, model.exposure)
    clock = _in_bursts(acquisition, clock, metrics)
    lit = clock.on_grid(_detect(metrics, clock, weight_margin=0.0).lit)
    columns = np.arange(samples.light.shape[0])
    likelihoods = channel.slot_likelihoods(samples, clock, model, lit, columns, is_initial=True)
    clock = _in_bursts(acquisition, clock, likelihoods.metrics)
    clock = sync.corrected(clock, likelihoods.timing)
    posteriors = _detect(likelihoods.metrics, clock)
    return Reception(clock, samples, contrast, posteriors, likelihoods.snr, model, likelihoods.metrics)


def in_other_bursts(acquisition: Acquisition, reception: Reception) -> Iterator[tuple[Reception, float]]:
    """Receptions with the copies assigned to bursts in other ways; none if the similarity of copies leaves no doubt.

    Each comes with the log-likelihood by which its copies are less similar.
    """
    (_, similarity), *rivals = sync.possible_bursts(reception.clock, slot_llr(reception.metrics), acquisition.repeats)
    for clock, rival_similarity in rivals:
        if similarity - rival_similarity <= SETTINGS.plain_bursts or not reception.is_complete.any():
            rival = replace(reception, clock=clock, posteriors=_detect(reception.metrics, clock))
            yield rival, similarity - rival_similarity


def as_one_column(reception: Reception) -> Reception:
    """Receive all columns as one that sends the same."""
    middle = reception.of_columns(np.array([reception.snr.shape[0] // 2]))
    metrics = reception.metrics.sum(axis=0, keepdims=True)
    return replace(middle, metrics=metrics, posteriors=_detect(metrics, middle.clock))


def doubtful_columns(reception: Reception) -> NDArray[np.int64]:
    """Columns with a complete packet of low confidence."""
    doubtful = (reception.packet_confidence < STILL.doubtful) & reception.is_complete
    return np.flatnonzero(doubtful.any(axis=0))


def _of_all_strips(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> Reception:
    """Receive some columns with all strips and all scales of the picture."""
    return _received(reception, columns, *_view(acquisition, reception, columns, STILL.coarse_samples))


def _without_row_noise(acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64]) -> Reception:
    """Receive some columns on the fine grid after removal of row noise."""
    samples, model = _view(acquisition, reception, np.arange(len(reception.snr)), denoise.SAMPLES_PER_SLOT)
    samples = denoise.remove_row_noise(reception.scene_of(samples, model)).samples
    return _received(replace(reception, cleaned=(samples, model)), columns, samples.of_columns(columns), model)


def _received(
    reception: Reception, columns: NDArray[np.int64], samples: SlotSamples, model: channel.ObservationModel
) -> Reception:
    """Receive some columns from their samples, given the slots decided so far."""
    lit = reception.clock.on_grid(reception.posteriors.lit)
    likelihoods = channel.slot_likelihoods(samples, reception.clock, model, lit, columns)
    return _with_metrics(reception, columns, likelihoods.metrics, likelihoods.snr)


def _with_metrics(
    reception: Reception, columns: NDArray[np.int64], metrics: FloatArray, snr: Float32Array
) -> Reception:
    """Replace the metrics of some columns and detect their words again."""
    of_all, snr_of_all = reception.metrics.copy(), reception.snr.copy()
    of_all[columns], snr_of_all[columns] = metrics, snr
    posteriors = reception.posteriors.with_columns(columns, _detect(metrics, reception.clock))
    return replace(reception, metrics=of_all, snr=snr_of_all, posteriors=posteriors)


def _view(
    acquisition: Acquisition, reception: Reception, columns: NDArray[np.int64], samples_per_slot: int
) -> tuple[SlotSamples, channel.ObservationModel]:
    """Sample all strips of some columns and adapt the light model of the initial pass to them."""
    clock, binned = reception.clock, reception.samples
    samples = sync.sample_slots(acquisition.profiles, clock, samples_per_slot, columns)
    n_strips = samples.light.shape[1]
    # Ratio of the pixels per sample in the initial pass to those here.
    larger = n_strips / binned.light.shape[1]
    larger *= _rows_per_sample(clock, binned.samples_per_slot) / _rows_per_sample(clock, samples_per_slot)
    model = replace(
        reception.model,
        noise=reception.model.noise.of_mean(1 / larger),
        crosstalk=Crosstalk.of(n_strips, acquisition.screen.light_spread),
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
    if options.cae == "never":
        return reception, frozenset(), None
    if options.cae == "always":
        columns = np.arange(reception.snr.shape[0])
        reception = _without_row_noise(acquisition, reception, columns)
    else:
        columns = _worth_showing(reception, doubtful_columns(reception))
    scene = reception.scene
    if columns.size == 0 or scene is None:
        return reception, frozenset(), None
    report: dict[str, Any] = {"model": denoise.DEFAULT_MODEL, "columns": columns.size, "kept": 0}
    try:
        denoiser = options.denoiser or _denoiser()
        corrections = denoiser.slot_corrections(scene, columns)
    except ReceiverError as error:
        return reception, frozenset(), {**report, "columns": 0, "message": str(error)}
    corrected = reception.metrics[columns] + channel.metrics_of(corrections, reception.model.exposure.isi_memory)
    after = _with_metrics(reception, columns, corrected, reception.snr[columns])
    improved = columns[(word_log_prob(after) > word_log_prob(reception))[columns]]
    report.update(model=denoiser.name, kept=improved.size)
    metrics = reception.metrics.copy()
    metrics[improved] = after.metrics[improved]
    posteriors = reception.posteriors.with_columns(improved, after.posteriors.of_columns(improved))
    # The network knows the positions of headers, so their presence is judged without it.
    posteriors = replace(posteriors, header_llr=reception.posteriors.header_llr)
    return replace(reception, metrics=metrics, posteriors=posteriors), frozenset(improved.tolist()), report


def _worth_showing(reception: Reception, columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """The surest of `columns`, as many as the time of the network allows."""
    if reception.cleaned is None:
        return columns[:0]
    n_strips = reception.cleaned[0].light.shape[1]
    n_columns = max(STILL.max_network_slots // (n_strips * reception.clock.n_slots), 1)
    return np.sort(columns[np.argsort(-best_log_prob(reception)[columns], kind="stable")[:n_columns]])


@lru_cache(maxsize=1)
def _denoiser() -> Denoiser:
    return denoise.load_denoiser()


def _in_bursts(acquisition: Acquisition, clock: Clock, metrics: FloatArray) -> Clock:
    """Assign copies to bursts by their similarity, from metrics (C, N + memory, patterns)."""
    return sync.possible_bursts(clock, slot_llr(metrics), acquisition.repeats)[0][0]


def _detect(metrics: FloatArray, clock: Clock, weight_margin: float = SETTINGS.weight_margin) -> BurstPosteriors:
    bursts = channel.by_burst(metrics, clock)
    return detect.detect(bursts, detect.plausible_weights(bursts, weight_margin))


def _light_model(acquisition: Acquisition, clock: Clock, samples: SlotSamples) -> channel.ObservationModel:
    profiles = acquisition.profiles
    rows = _rows_per_sample(clock, samples.samples_per_slot)
    black_level = channel.estimate_black_level(samples, clock)
    min_sigma = 0.5 * noise_of(profiles) / rows**0.5
    sigma = dark_sigma(samples.light, samples.valid, black_level, min_sigma)
    return channel.ObservationModel(
        black_level=black_level,
        noise=NoiseModel(sigma**2, profiles.noise_slope / max(float(np.median(profiles.count)), 1.0) / rows),
        crosstalk=Crosstalk.of(samples.light.shape[1], acquisition.screen.light_spread),
        exposure=Exposure.of(clock.exposure_slots, samples.samples_per_slot),
    )


def _rows_per_sample(clock: Clock, samples_per_slot: int) -> float:
    return max(clock.rows_per_slot / samples_per_slot, 1.0)
