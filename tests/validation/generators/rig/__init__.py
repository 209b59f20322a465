"""The virtual rig's hidden effects (`rig.hidden`).

plan        what is made, in an order of which every beginning is balanced
limit       how strong an effect must be to be found, by the rig's reckoning
generator   the generator, and the report on its records
"""
