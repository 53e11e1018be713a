"""Claims of jobs that share a study."""

import time
from itertools import pairwise

import pytest

from uq.evaluation.claims import BEAT, Claims, FinishedElsewhere


@pytest.fixture
def jobs(tmp_path):
    """Make a job of a name; the study is finished once there is a file."""

    def job(name, patience=60.0):
        made = Claims(tmp_path / "claims", name, (tmp_path / "summary.json").exists, patience)
        made.begin()
        return made

    return job


@pytest.mark.unit
def test_one_of_two_has_a_claim_until_it_drops_it(jobs):
    one, two = jobs("1"), jobs("2")
    assert one.take("block")
    assert not two.take("block")
    assert two.take("other")
    one.drop("block")
    assert two.take("block")
    one.drop("block")  # no longer its own
    assert not one.take("block")


@pytest.mark.unit
def test_what_a_job_of_the_same_name_has_left_is_free_and_that_of_others_is_not(jobs):
    assert jobs("1").take("block")
    assert jobs("2").take("other")
    again = jobs("1")
    assert again.take("block")
    assert not again.take("other")


def test_a_claim_that_nobody_changes_is_taken_over_and_one_that_is_beaten_is_not(jobs, tmp_path):
    dead, alive, heir = jobs("dead"), jobs("alive"), jobs("heir", patience=0.05)
    assert dead.take("left")
    assert alive.take("kept")
    assert not heir.take("left")
    assert not heir.take("kept")  # seen for the first time
    time.sleep(0.1)
    alive._beaten -= 2 * BEAT  # as if so much time had passed
    alive.beat()
    assert heir.take("left")
    assert not heir.take("kept")
    assert (tmp_path / "claims" / "left.claim").read_text() == "heir"
    dead.drop("left")  # slow, not dead: it leaves the claim to who has it now
    assert not jobs("another").take("left")


def test_patience_grows_with_the_longest_piece_of_work(jobs):
    dead, slow = jobs("dead"), jobs("slow", patience=0.05)
    dead.take("left")
    slow.take("long")
    time.sleep(0.2)
    slow.drop("long")
    assert not slow.take("left")
    time.sleep(0.2)
    assert not slow.take("left")  # 0.4 s are less than five times 0.2


@pytest.mark.unit
def test_nothing_is_claimed_nor_awaited_once_the_study_is_finished(jobs, tmp_path):
    one, two = jobs("1"), jobs("2")
    assert one.take("block")
    one.writes()
    (tmp_path / "summary.json").write_text("{}")
    assert not two.take("another")
    with pytest.raises(FinishedElsewhere):
        two.wait(news=False)
    with pytest.raises(FinishedElsewhere):
        two.writes()
    assert sorted(path.name for path in (tmp_path / "claims").iterdir()) == ["block.claim", "results.claim"]


@pytest.mark.unit
def test_a_folder_that_is_gone_is_made_again_unless_the_study_is_finished(jobs, tmp_path):
    one = jobs("1")
    (tmp_path / "claims").rmdir()
    assert not one.take("block")
    assert one.take("block")
    one.drop("block")
    (tmp_path / "claims").rmdir()
    (tmp_path / "summary.json").write_text("{}")
    assert not one.take("block")
    assert not (tmp_path / "claims").exists()


@pytest.mark.unit
def test_jobs_begin_apart(jobs):
    pieces = tuple(range(100))
    turned = [jobs(name).turned(pieces) for name in ("0", "1", "2", "3", "a job")]
    assert all(sorted(one) == list(pieces) for one in turned)
    first = sorted(one[0] for one in turned[:4])
    assert min(b - a for a, b in pairwise(first)) > 10
    assert jobs("7").turned(()) == ()
