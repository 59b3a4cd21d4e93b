"""The profile of a frame: every operation is counted once, for the function that calls it."""

from tools import profile_joint


def test_operations_are_counted_for_the_function_that_calls_them(capsys):
    profile_joint.print_profile(rows=1, segments=12, runs=1)
    first, *rest, cache, memory = (line.split() for line in capsys.readouterr().out.splitlines())
    assert first[-1] == "all"
    assert int(first[4]) == sum(int(line[4]) for line in rest) > 1000
    assert {"update.information", "residuals.look"} < {line[-1] for line in rest}
    assert cache[1] == memory[1] == "GB/s"
