"""What a picture says of the camera that took it: rows per slot, direction of readout, exposure, bend of the stripes.

Six steps on the row profiles, none of which needs to know the camera. Before them the screen's sides are looked at
(`screen.side_curvature`): bowed ones mean that the lens's distortion is still in the picture, whose stripes are then
straight, and straight ones that the camera took it out (`Strips.correction`).

1. **Bend.** Neighbouring strips show the same slots, so the lag between them, over all of the picture, is the slope of
   the stripes. Where a camera has taken the distortion out of its picture, the sensor row of a point p is the y of
   K distort(K^-1 p); with any focal length in K the same map comes out for other coefficients, so that one width is
   taken and k1 k2 p1 p2 are what is sought.
2. **Short list.** Edges fall between slots, so that their power has a line at the rate of the slots; and columns are
   like themselves a packet later. The periods that stand out so, with the headers that show there, are the short list
   (`scan`). The header read backwards, 1100011100, is its own complement, so the sign tells the direction.
3. **Reading.** The best of them is read through an exposure, knowing nothing of packets, and packets of every length
   and start are sought among its slots (`reading`). Where nothing reads surely, clocks of all periods are read.
4. **Rounds.** Light of neighbouring slots overlaps through the exposure, and nobody told its levels: levels and slots
   follow from one another, by forward-backward, one round of them for every step of the clock.
5. **Refinement.** The slots, as probabilities seen through the exposure, predict the light of every strip on every row.
   What is missing is the derivative with respect to time: least squares over all strips gives row and period of the
   clock and the bend at once, with standard deviations from the spread between columns.
6. **Once more.** The receiver's own light model and codebook know the slots better than step 4. With those it has
   decoded the least squares of step 5 are done again (`refit`), with what rows see of them worked out for sensor rows
   (`rows`) and the texture of the picture foretold, and the picture received again where that matters.
"""

from rxcli.receiver.camera.advice import stripe_likeness, why_not
from rxcli.receiver.camera.camera import (
    camera_profile,
    curving_lens,
    in_time_order,
    lens_of,
    summary,
    summary_of_rows,
)
from rxcli.receiver.camera.columns import likely_columns
from rxcli.receiver.camera.curvature import curvature_terms, estimate_curvature, straightened
from rxcli.receiver.camera.edges import by_edges
from rxcli.receiver.camera.estimates import BlindEstimate, Hypothesis
from rxcli.receiver.camera.refit import refit
from rxcli.receiver.camera.search import BlindSearch, Periods, estimate_camera, stripes_are_curved
from rxcli.receiver.camera.strips import Strips, in_readout_order, side_curvature_of, strips_of
from rxcli.receiver.camera.structure import structure_llr
from rxcli.receiver.camera.tone import is_linear

__all__ = [
    "BlindEstimate",
    "BlindSearch",
    "Hypothesis",
    "Periods",
    "Strips",
    "by_edges",
    "camera_profile",
    "curvature_terms",
    "curving_lens",
    "estimate_camera",
    "estimate_curvature",
    "in_readout_order",
    "in_time_order",
    "is_linear",
    "lens_of",
    "likely_columns",
    "refit",
    "side_curvature_of",
    "straightened",
    "stripe_likeness",
    "stripes_are_curved",
    "strips_of",
    "structure_llr",
    "summary",
    "summary_of_rows",
    "why_not",
]
