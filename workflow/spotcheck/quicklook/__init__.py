"""First look at images without a description: widths, clipped pixels, camera noise, M².

In: image files or a folder of them. Out: a `Look` with the results of images, cameras and scan, as text, JSON or a
page.
"""
