"""What is known of one frame: its plane and samples, outline, camera and clock, passes, result and the time they took.

Only the wiring (`receive`, `search`, `still`, `clip`) uses this room; the stages know nothing of it.
"""
