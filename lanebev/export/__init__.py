"""LaneBEV for other runtimes: its parts as ONNX files or exported programs, and a run by them.

``names`` lists the parts. ``parts`` and ``state_parts`` make each ``part`` with an example of its inputs,
``write`` writes it with the ``operators`` that ONNX lacks, ``quantize`` reduces the segmenter to 8 bits, and
``runtime`` computes with the files.
"""
