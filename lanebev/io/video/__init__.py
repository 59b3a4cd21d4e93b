"""Videos.

``decoding`` and ``seeking`` read frames, ``writer`` writes them; ``remarks`` says what is odd about a whole
video.
"""
