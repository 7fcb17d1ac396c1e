"""Receiver: from a frame to packets by screen, plane, camera, sync, channel and decode.

`receive.receive_frame` reads as the block diagram; `still` and `clip` run the stages of photographs and clips.
"""
