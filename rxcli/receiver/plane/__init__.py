"""Pixels to row profiles: each pixel of a frame is read once, into a plane from which profiles are sampled."""
