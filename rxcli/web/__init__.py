"""A local page for photos from a phone and for a live camera (extra `web`).

`server` speaks HTTP and touches no picture; `decoding` does that in a process of its own that may die without harm;
`live` follows a camera in another one. `page/` is what the browser gets.
"""
