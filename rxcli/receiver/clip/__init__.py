"""Clips: what one frame teaches is used on the next. The stages are those of `rxcli.receiver.pipeline`.

The first frame is received like a photograph (`receiver`). From then on outline, clock, picture, light spread and
weights are known: the strips are read where they were (`sampling.tracked`), the picture is taken out (`scene`, by
`channel.known_picture`), the clock is foretold and checked against the header (`sync.tracking`). Where the check fails,
the frame is received like a photograph again. What frames see of a burst is added up before it is detected (`bursts`);
a packet stands in the last frame that shows its burst, so results come a frame late (`results`). Where each frame shows
little, the first ones find their clock together (`start`).
"""

from rxcli.receiver.clip.receiver import receive_clip

__all__ = ["receive_clip"]
