"""Numbers of policy of the search: what evidence is worth, when to stop, how near a rival must be."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Each with its unit and the reason for it. Evidence is a log-likelihood ratio for a screen of twenty columns."""

    #: Evidence counts this much in the score, because samples err together.
    temper: float = 0.08
    #: Headers without symbols count this much beside packets.
    header_weight: float = 0.1
    #: Evidence that a complete packet adds; and the weight of the copies' similarity, which packets hold half already.
    complete_packet: float = 60.0
    copies_weight: float = 0.5
    #: Above this evidence no further cameras are proposed: wrong clocks reach 391.
    plain: float = 400.0
    #: Below this evidence there are no packets: wrong clocks mostly show less than 10, right ones 80.
    bail: float = 20.0
    #: Below this evidence an estimated camera is none: on a wrong one nothing shows more.
    few_packets: float = 40.0
    #: Initial passes of a frame at most, and those that may pass without any evidence.
    budget: int = 24
    hopeless_budget: int = 8
    #: Siblings of a scored hypothesis get a pass where their score could come this near to the best one.
    reach: float = 3.0
    #: Columns below which all of them rank as quickly as the middle half.
    few_columns: int = 8
    #: Header lead (peak over rival) of a clock beyond doubt, log prior lost per e-fold below it, least lead of a clock.
    clear_lead: float = 3.0
    lead_weight: float = 2.0
    min_lead: float = 1.6
    #: Log prior that each further camera loses, and rows that are not the outline's likeliest.
    next_camera: float = 0.5
    other_rows: float = 2.5
    #: Log prior lost per e-fold of the misfit of a number of columns.
    columns_weight: float = 4.0
    #: Bursts are settled where this share of the columns has packets of such confidence, or where the similarity of
    #: copies leads by so much log-likelihood.
    clear_columns: float = 0.9
    clear_confidence: float = 0.9
    plain_bursts: float = 300.0
    #: Probability from which a column's number is likely, and from which it is reported as the screen's; log-odds
    #: within which an outline may be the right one.
    likely_certainty: float = 0.5
    sure_certainty: float = 0.9
    may_be_log_odds: float = 3.0


SETTINGS = SearchSettings()
