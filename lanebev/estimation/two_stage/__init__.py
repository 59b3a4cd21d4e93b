"""The paper's calibrator: ``vanishing`` direction, then ``lane_width``.

``calibrator`` passes a frame through ``direction`` (stage 1) and ``roll_height`` (stage 2); ``departures``
adds to the covariance what roads that differ from the model do; ``state`` defines state and configuration.
"""
