"""Row profiles to a clock and slot samples (`clock`); the time of the link through a clip (`tracking`)."""
