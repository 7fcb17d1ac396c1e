"""Settings of the presence of packets, and of the passes of a still."""

import msgspec


class PassSettings(msgspec.Struct, frozen=True):
    """Thresholds, each with its unit and its reason."""

    #: Log-likelihood ratio of headers and packets below which a picture contains no packets: without data it is below
    #: 10, with packets at least 74 in 120 hard pictures.
    min_packets_llr: float = 20.0

    #: Log-likelihood ratio from which a column has packets even without a header: of 16 packets more than at 100 in 350
    #: stills all were right. Wrong clocks, which show none in any column, reach 74.
    min_headerless_llr: float = 60.0


class StillSettings(msgspec.Struct, frozen=True):
    """Thresholds, each with its unit and its reason."""

    #: Samples per slot of the first passes.
    coarse_samples: int = 2
    #: Fewest rows of a sample of later ones: a mosaic repeats after two.
    min_sample_rows: float = 2.0
    #: Fewest rows per slot of a joint detection.
    min_joint_rows: float = 2.0
    #: Black level where no header is in view: contrast up to which light is dark, -1 dark to 1 lit; and the percentile
    #: of such light, as some of it is lit in part.
    dark_contrast: float = -0.7
    dark_quarter: float = 25
    #: Black level of a long exposure, as a share of a percentile of the light.
    dark_share: float = 0.95
    dark_percent: float = 0.5
    #: Shares that are compared by evidence, on some columns.
    dark_shares: tuple[float, ...] = (0.0, 0.4, 0.7, 0.85, 1.0, 1.1)
    n_judged_columns: int = 5
    #: Exposures that are compared likewise, as factors.
    exposure_factors: tuple[float, ...] = (0.87, 0.96, 1.0, 1.04, 1.15)
    #: Limit of the log evidence of a column for an assignment of copies to bursts.
    max_column_gain: float = 40.0
    #: Least log probability of a weight by the initial pass that the joint detection starts from.
    min_weight_log_prior: float = -3.0
    #: The same of packets whose dimming symbol is out of view.
    no_weight: float = -40.0
    #: Minimum confidence of a packet that the auto-encoder corrected.
    min_corrected_confidence: float = 0.1
    #: Confidence of a packet below which its column gets further passes.
    doubtful: float = 0.985
    #: Limit of strip slots for the network, which takes most of the time; the least certain columns are left out.
    max_network_slots: int = 100_000


SETTINGS, STILL = PassSettings(), StillSettings()
