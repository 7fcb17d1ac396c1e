"""Settings of the wiring (screen, camera, presence of packets) and of the passes of a still."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WiringSettings:
    """Thresholds, each with its unit and its reason."""

    #: Log-likelihood ratio of headers and packets below which a picture contains no packets: without data it is below
    #: 10, with packets at least 74 in 120 hard pictures.
    min_packets_llr: float = 20.0

    #: Largest shift of the light of one lamp between columns, slots: blinds may be slanted.
    max_column_shift_slots: int = 10
    #: Detection of switched light without a clock: smoothing and longest period, rows; minimum explained share.
    smooth_rows: int = 2
    max_period_rows: int = 100
    switched_share: float = 0.7

    #: Log-likelihood below the best weight at which a weight is dropped.
    weight_margin: float = 20.0
    #: Lead of an assignment of copies to bursts, log-likelihood of their similarity, that is beyond doubt.
    plain_bursts: float = 24.0
    #: Log-likelihood ratio from which a column has packets even without a header: of 16 packets more than at 100 in 350
    #: stills all were right. Wrong clocks, which show none in any column, reach 74.
    min_headerless_llr: float = 60.0

    #: Minimum overlap of a given outline and the picture, as a fraction of either.
    min_overlap: float = 0.002
    #: Minimum number of rows for blind camera estimation.
    min_rows: int = 24
    #: Mean, as a share of white, below which a picture without a screen is reported as dark.
    dark_mean: float = 0.08
    #: Largest size of an outline relative to the picture, beyond which less than one column is visible.
    largest_outline: float = 50.0


@dataclass(frozen=True, slots=True)
class StillSettings:
    """Thresholds, each with its unit and its reason."""

    #: Samples per slot of the first passes.
    coarse_samples: int = 2
    #: Confidence of a packet below which its column gets further passes.
    doubtful: float = 0.985
    #: Limit of strip slots for the network, which takes most of the time; the least certain columns are left out.
    max_network_slots: int = 100_000


SETTINGS, STILL = WiringSettings(), StillSettings()
