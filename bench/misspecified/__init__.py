"""What an effect that the simulator lacks does to tuners: every tuner in the simulator as it is,
and in the one that explain extended from a recording of the same world.
"""
