"""A first look at images that nobody has described.

In: image files or a folder of them. Out: a `Look` with what was seen of spots, camera and scan, as text, JSON
or a page.
"""
