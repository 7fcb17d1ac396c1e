"""Pixels to row profiles: the one pass over the picture (`rows`), and the quick one of clips (`tracked`)."""

from rxcli.receiver.sampling.rows import is_coded, sample_rows, strips_per_column, tone_to_light
from rxcli.receiver.sampling.store import RowStore

__all__ = ["RowStore", "is_coded", "sample_rows", "strips_per_column", "tone_to_light"]
