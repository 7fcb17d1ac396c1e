"""Clips: what one frame teaches is used on the next. The stages are those of `rxcli.receiver.receive`.

    frames -> window -> stream -> bursts -> results

`window` looks at first frames together: they agree on an outline, on a camera (`camera`) and, where each shows little,
on a clock (`common_clock`). In the stream (`receiver`) the screen is followed (`follow`, `place`) and its strips are
read where they are (`plane.tracked`); the picture is taken out (`scene`, `measure`, by `channel.known_picture`), the
clock is predicted and checked against the header (`sync.tracking`). Where the check fails, the frame is received like a
photograph again. The link's time numbers the bursts of all frames (`timeline`), and what frames show of a burst is
added up before it is detected (`bursts`). A packet stands in the last frame that shows its burst, so results wait a
frame (`ledger`) until they are complete (`reporting`).
"""

from rxcli.receiver.clip.receiver import receive_clip

__all__ = ["receive_clip"]
