from s2a_bench.plan import Validity, load_skills, measure_validity, paper_format, score

PAPER = paper_format(load_skills("household"))
GOOD = "1. go_to(kitchen)\n2. pick(cup)\n"


def test_valid_skills_are_counted_against_all_lines_that_were_wanted() -> None:
    answers = [
        [GOOD],
        list(GOOD),
        ["Here is the plan:\n", GOOD],
        ["1. go_to(moon)\n2. dance()\n3. pick(cup)\n"],
        ["1. pick(cup)"],
        [],
    ]
    found = score(PAPER, answers, n_skills=2)
    assert found == Validity(6, 6, {"malformed": 1, "bad-argument": 1, "unknown-skill": 1}, 2)
    assert found.share == 6 / 9


def test_an_answer_that_goes_on_is_not_as_ordered_and_weighs_no_more() -> None:
    assert score(PAPER, [[GOOD, GOOD, "and so on\n"]], 2) == Validity(1, 2, {}, 0)


def test_nothing_said_has_no_share() -> None:
    assert score(PAPER, [["\n \n"]], 2).share is None


def test_the_same_seeds_are_asked_with_the_grammar_and_without() -> None:
    asked = []

    def ask(gbnf: str, seed: int) -> list[str]:
        asked.append((bool(gbnf), seed))
        return [GOOD if gbnf else "no"]

    found = measure_validity(ask, PAPER, 2, answers=3)
    assert asked == [(True, 0), (True, 1), (True, 2), (False, 0), (False, 1), (False, 2)]
    assert (found["grammar"].share, found["free"].share) == (1.0, 0.0)
    assert (found["grammar"].as_ordered, found["free"].as_ordered) == (3, 0)
