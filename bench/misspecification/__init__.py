"""Study of model misspecification: tuners in a simulator with a missing effect.

Every tuner is compared in the original simulator, and in the one that explain extended from a
recording of the same true system.
"""
