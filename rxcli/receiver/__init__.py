"""From a frame to what was sent: screen, sampling, camera, sync, channel, decode, one room each.

`pipeline.receive_frame` reads as the block diagram; `still` and `clip` say in which order the stages are taken.
"""
