"""The light model: picture, crosstalk and exposure, estimated blindly together with the slots.

What strip s of column c sees at exposure centre g (in slots) is

    z = floor + T * (sum over k of K[s, k] * m[c + k](g)),      m(g) = sum over slots n of lit[n] * h(g - n)

with T the picture there (textured, different in every strip), K the light spread from column c + k into the strip
(smooth, known from the screen), h a slot seen through the exposure (a trapezoid) and m the same for all strips. The
picture is predicted at every sample from the samples before it, from those after it and from both, never from the slot
itself. Each prediction is made on several scales at once; the scale that has predicted best thereabouts is taken, and
its error is the variance of the prediction. The likelihood of a sample is the mixture over the three predictions
(where the picture has an edge, one side alone tells) of a Student-t density (an edge in one strip must not outweigh
seven others). The metric of a slot pattern is the sum of its logarithm over strips and samples.

The slots themselves are needed to predict the picture, so model and detection are iterated, from a first guess that
compares every sample to the extremes around it.

These metrics take every slot by itself, the picture being predicted with all others as believed. Where a symbol stays
in doubt, its likeliest words are weighed as a whole (`word_corrections`): the picture is then a random process along
time, followed by a Kalman filter through the symbol and the slots around it, and the likelihood of a word is that of
its innovations.

`model` holds what is the same all over a frame, `picture` predicts, `likelihoods` compares, `words` weighs words, and
`patterns` brings slots and metrics from the frame's grid to bursts and back.
"""

from rxcli.receiver.channel.likelihoods import SlotLikelihoods, slot_likelihoods
from rxcli.receiver.channel.model import ObservationModel, estimate_black_level, estimate_sigma
from rxcli.receiver.channel.patterns import by_burst, initial_metrics, metrics_of
from rxcli.receiver.channel.words import word_corrections

__all__ = [
    "ObservationModel",
    "SlotLikelihoods",
    "by_burst",
    "estimate_black_level",
    "estimate_sigma",
    "initial_metrics",
    "metrics_of",
    "slot_likelihoods",
    "word_corrections",
]
