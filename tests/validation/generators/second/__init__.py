"""Camera, light and effects of hidden sets, written by somebody who had read the dataset contract and the paper, and
nothing of the library or the rig: what one reader of the contract takes for granted the other may not.

case       what a data set is before it is rendered: grid of frames, camera, base spot, effects
optics     light on the sensor: spot, blur, halo, ghost, stripes, grain, pedestals
sensor     from light to readings
effects    the 24 effects, each in a form drawn at random
sheet      the data sheet of a case
"""
