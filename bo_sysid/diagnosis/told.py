"""A diagnosis told from its first sentence to its last."""

from collections.abc import Mapping

from bo_sysid.diagnosis.answer.hints import hints, leaves_much, left_sentence
from bo_sysid.diagnosis.answer.holdout import Holdout
from bo_sysid.diagnosis.answer.notes import unsought_sentence
from bo_sysid.diagnosis.answer.seen_once import seen_in_a_part, seen_once
from bo_sysid.diagnosis.answer.sentences import (
    disagreements,
    disputed_sentence,
    doubts,
    found_sentences,
    noise_sentence,
    parameters_sentence,
    rivals,
    shift_sentence,
    stood_in_sentence,
)
from bo_sysid.diagnosis.answer.trifle import trifle_sentence
from bo_sysid.diagnosis.answer.uncrossed import uncrossed_sentence
from bo_sysid.diagnosis.frozen import Frozen

_HINTS = (
    "What follows are hints, not yet findings: with a probability of {:.1f} it is something else."
)
_CONTACT = "They are no more than hints since the machine is in contact, or meets its stops."


def told(frozen: Frozen, holdout: Holdout, shifts: Mapping[str, float]) -> tuple[str, ...]:
    """Return a diagnosis in words.

    Args:
        frozen: what the training recordings say.
        holdout: how well that forecasts the others.
        shifts: seconds by which the study takes commands later than stamped, by channel or kind.
    """
    after = frozen.answer.next_experiment
    said = [
        *_found(frozen),
        *_beside(frozen, shifts),
        *_reservations(frozen),
        *holdout.sentences,
        noise_sentence(frozen.evidence.input_noise),
        after.sentence if after else "",
    ]
    return tuple(words for words in said if words)


def _found(frozen: Frozen) -> list[str]:
    """Return what is missing, or that nothing is."""
    answer = frozen.answer
    sentences = [
        _HINTS.format(answer.none_of_these) if answer.hinted else "",
        *found_sentences(answer.findings),
        *answer.unexplained.sentences,
        disputed_sentence(frozen.outcome.disputed),
        *disagreements(frozen.outcome.fit.members, frozen.outcome.sessions.table),
    ]
    if any(sentences):
        return sentences
    once = "" if frozen.parameters.empty else ", once its parameters are fitted"
    other = sum(float(a["probability"]) for a in answer.alternatives)
    return [
        f"Nothing that these recordings could show is missing from the model{once} "
        f"(probability {1.0 - other:.2f})."
    ]


def _beside(frozen: Frozen, shifts: Mapping[str, float]) -> list[str]:
    """Return what may be instead of what was found, what was fitted beside it, and assumed."""
    decision, evidence = frozen.located.decision, frozen.evidence
    assumed = [
        parameters_sentence(frozen.parameters),
        stood_in_sentence(evidence.nuisances, frozen.outcome.fit),
        shift_sentence(shifts),
        unsought_sentence(evidence),
    ]
    if frozen.outcome.fit.key != decision.best.key:  # a name was withdrawn: rivals were of it
        return assumed
    instead = rivals(decision, evidence.machine)
    return [*instead, *assumed, *doubts(decision, frozen.searched)]


def _reservations(frozen: Frozen) -> list[str]:
    """Return why names are hints, and what was seen too rarely to name."""
    located, evidence, best = frozen.located, frozen.evidence, frozen.outcome.fit
    answer = frozen.answer
    sentences = [_CONTACT if frozen.contact and answer.findings else ""]
    if answer.findings and not frozen.contact and leaves_much(best):
        sentences.append(left_sentence(best, evidence.most, located.search.nearest))
    if frozen.small and answer.findings:
        sentences.append(trifle_sentence(best))
    sentences += hints(best, evidence.machine, located.decision.fits, evidence.still)
    if frozen.uncrossed:
        sentences.append(uncrossed_sentence(frozen.uncrossed))
    if not frozen.contact and not answer.unexplained.depends_on:  # else a law says when it acts
        problem, Q = located.prepared.problem, located.prepared.linear.Q
        sentences.append(seen_once(problem, Q, best) or seen_in_a_part(problem, Q, best))
    return sentences
