"""Text of a judgement, for terminals."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from typing import Final

from spatial_replay.judging.judgement import JudgedEpisode, Judgement, Kind
from spatial_replay.judging.statistics import Rate
from spatial_replay.text import first_lines, listing, plural

_TITLES: Final[dict[Kind, str]] = {
    "only_theirs": "only the label counts",
    "only_ours": "only the verdict counts",
    "unstored": "unstored",
    "undecided": "undecided",
}
_MOST: Final = 10
"""Maximum number of lines for each kind."""
_MOST_IN_LINE: Final = 5


def summary_lines(judgement: Judgement) -> Iterator[str]:
    """Yield lines with the judged episodes, the rates of verdicts and labels, and their agreement."""
    episodes_text = plural(len(judgement.rows), "episode")
    yield f"{judgement.name}: {episodes_text} judged by `{judgement.result}`, `{judgement.formula}`"
    agreement = judgement.agreement
    rates = [*_rates("ours", judgement)]
    rates += [("label", judgement.label_rate, "")] if judgement.label_rate.episodes else []
    rates += _rates("against", judgement.comparison.old) if judgement.comparison else []
    rate_texts = [f"{rate.successes:,} of {rate.episodes:,}" for _, rate, _ in rates]
    rate_width = max(map(len, rate_texts))
    yield f"{'':10}{'success':<{rate_width + 9}}95 %"
    for rate_text, (name, rate, suffix) in zip(rate_texts, rates, strict=True):
        yield f"{name:<10}{rate_text:<{rate_width}}  {_percents(rate)}{suffix}"
    agreement_counts = {
        "both": agreement.both,
        "only the label": agreement.only_theirs,
        "only ours": agreement.only_ours,
        "neither": agreement.neither,
    }
    other_counts = {"unstored": agreement.unstored, "undecided": agreement.undecided}
    other_counts["without a label"] = len(judgement.rows) - judgement.label_rate.episodes
    if not judgement.label_rate.episodes:
        agreement_counts, other_counts = {}, {"no labels; undecided": agreement.undecided}
    agreement_counts |= {name: number for name, number in other_counts.items() if number}
    if agreement_counts:
        agreement_text = f"{agreement.both + agreement.neither:,} of {agreement.compared:,}"
        beginning = f"agreement {agreement_text:<{rate_width + 9}}" if judgement.label_rate.episodes else ""
        yield f"{beginning}{', '.join(f'{name} {number:,}' for name, number in agreement_counts.items())}"
    if judgement.pass_k:
        yield ", ".join(f"pass^{k} {100.0 * value:.0f} %" for k, value in judgement.pass_k.items())


def _rates(name: str, judgement: Judgement) -> Iterator[tuple[str, Rate, str]]:
    """Yield the name, the rate and the end of the line for each rate of a judgement."""
    yield name, judgement.rate, ""
    if unstored := judgement.agreement.unstored:
        yield "", judgement.rate_with_unstored, f"   if the {unstored:,} unstored count"


def _percents(rate: Rate) -> str:
    if rate.value is None or rate.interval is None:
        return "no rate"
    low, high = rate.interval
    return f"{f'{100.0 * rate.value:.0f} %':<7}{100.0 * low:.0f} to {100.0 * high:.0f}"


def difference_lines(judgement: Judgement) -> Iterator[str]:
    """Yield lines with undecided episodes, and with disagreements of label and verdict, with reasons."""
    for kind, title in _TITLES.items():
        rows = [row for row in judgement.rows if row.kind == kind]
        if rows:
            yield ""
            yield f"{title} {len(rows):,}:"
            episodes_by_reason = defaultdict[tuple[str, str], list[str]](list)
            for row in rows:
                # undecided episodes with the same reason share a line
                episodes_by_reason[_reason(row), "" if kind == "undecided" else row.episode].append(
                    row.episode
                )
            episode_lists = [listing(episodes, _MOST_IN_LINE) for episodes in episodes_by_reason.values()]
            width = max(map(len, episode_lists[:_MOST]))
            reason_lines = [
                f"  {name:<{width}}  {reason}"
                for name, (reason, _) in zip(episode_lists, episodes_by_reason, strict=True)
            ]
            yield from first_lines(reason_lines, _MOST)


def failure_lines(judgement: Judgement) -> Iterator[str]:
    """Yield a line for each first failure: its name, the number of its episodes, and the first episodes."""
    episode_count = sum(map(len, judgement.failures.values()))
    yield f"first failures of the {plural(episode_count, 'episode')} that fail `{judgement.result}`"
    failure_names = {name: name or "another failure" for name in judgement.failures}
    width = max(map(len, failure_names.values()), default=0)
    for name, rows in judgement.failures.items():
        episodes = listing([row.episode for row in rows], _MOST_IN_LINE)
        yield f"  {failure_names[name]:<{width}}  {len(rows):>{len(str(episode_count))},}  {episodes}"


def stage_lines(judgement: Judgement) -> Iterator[str]:
    """Yield a line for each stage: the number of episodes that end in the stage.

    A line also has the number of labelled failures that end in the stage.
    """
    failed_rows = [row for row in judgement.rows if row.label is False]
    heading, end_heading = f"stages of `{judgement.result}`", "at the end"
    width = max(map(len, (*judgement.stages, heading)))
    failure_heading = f"of the {len(failed_rows):,} that the label calls failures"
    yield f"{heading:<{width}}  {end_heading}  {failure_heading if failed_rows else ''}".rstrip()
    stage_counts = [Counter(row.stage for row in rows) for rows in (judgement.rows, failed_rows)]
    for name in judgement.stages:
        end_count, failure_count = (f"{count[name]:,}" for count in stage_counts)
        line = f"{name:<{width}}  {end_count:<{len(end_heading)}}  "
        yield f"{line}{failure_count if failed_rows else ''}".rstrip()


def _reason(row: JudgedEpisode) -> str:
    is_early = row.kind == "only_ours" and row.success_at is not None
    success = f"succeeds at {row.success_at:.3f} s; " if is_early else ""
    return f"{success}{row.reason.split(chr(10))[0]}"
