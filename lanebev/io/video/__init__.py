"""Videos.

``decoding`` and ``seeking`` read frames, ``writer`` writes them. ``side_by_side`` tells that a frame shows
two cameras; ``remarks`` says what is odd about a whole video.
"""
