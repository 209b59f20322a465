"""Real frames, as they are and with a known effect put into their readings. They lie beside the repository.

beams       frames of a HeNe beam, each a data set of its own; their page and, in beams_picture, its picture
levels      flats and darks of a CCD
sensor      the page of that CCD, beside the standard's own package (emva)
generator   the data sets of both, and the pages of their records
"""
