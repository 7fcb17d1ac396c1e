"""A local page for photos from a phone and for a live camera (extra `web`).

`server` handles HTTP and never opens a picture. `decoding` decodes pictures in a separate process that may die without
harm, and `live` follows a camera in another. The folder `pages` holds the files for the browser.
"""
