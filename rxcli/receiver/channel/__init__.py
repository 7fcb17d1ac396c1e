"""Light model: picture, crosstalk and exposure, estimated blindly together with the slots.

Strip s of column c, exposed around the time g (in slots), receives

    z = black level + T * (sum over k of K[s, k] * m[c + k](g)),      m(g) = sum over slots n of lit[n] * h(g - n)

where T is the local picture (textured, different in every strip), K the crosstalk from column c + k into the strip
(smooth, known from the screen), h a slot convolved with the exposure (a trapezoid), and m the same for all strips.

The picture is predicted at every sample from earlier samples, from later samples and from both, never from the slot
itself. Each prediction uses the scale with the smallest local error, and that error is the variance of the prediction.
The likelihood of a sample is a mixture over the three predictions, because at an edge of the picture only one side is
valid. Its density is Student-t, so that an edge in one strip does not outweigh the other strips. The metric of a slot
pattern is the sum of the log-likelihoods over strips and samples. What the channel hands on is the log-likelihood ratio
of every slot by itself, each with its neighbours as likely as their own light has them.

The prediction of the picture needs the slots, so model and detection are iterated. The initial ratios compare every
sample with its local extremes.

`model` holds the parameters of a frame, `steady` takes off light that does not blink, `picture` predicts the picture,
`likelihoods` computes metrics, and `patterns` turns these into ratios of slots, and of words what samples of several
slots add to these.
"""

from rxcli.receiver.channel.likelihoods import SlotLikelihoods, slot_likelihoods
from rxcli.receiver.channel.model import ObservationModel, estimate_black_level, estimate_tails
from rxcli.receiver.channel.patterns import beyond_slots, initial_llr, lit_of, llr_of
from rxcli.receiver.channel.steady import within_light, without_steady_light

__all__ = [
    "ObservationModel",
    "SlotLikelihoods",
    "beyond_slots",
    "estimate_black_level",
    "estimate_tails",
    "initial_llr",
    "lit_of",
    "llr_of",
    "slot_likelihoods",
    "within_light",
    "without_steady_light",
]
