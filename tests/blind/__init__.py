"""The blind suite: datasets with hidden effects are judged, and the judgements scored against a truth kept apart.

plan         what is run, in an order of which every beginning is balanced
judge_case   a case, drawn and judged in memory: with `told`, all that the suite knows of the library's functions
by_command   the same case through folder, TIFF and command line
told         what a model does that is told the truth: gap, errors, isolability
limit        how strong an effect must be to be found, by the rig's reckoning
records      one line a job, in a file that later calls add to
run          the command: as many jobs as the time allows, then scores
outcome      what one record says, and whether it is right
score        from records to figures; figure, intervals, power: what they are made of
table, picture    how figures are written and drawn
"""
