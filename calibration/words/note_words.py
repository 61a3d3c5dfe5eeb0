"""Tables of `calibration.described.describe`: the sentence of each kind of note and of each result."""

from __future__ import annotations

from collections.abc import Callable

from calibration.data.settling import Settled
from calibration.discovery import findings, formula, loop_notes
from calibration.discovery import result as loop_results
from calibration.inference import fit_notes
from calibration.inference import result as fit_results
from calibration.inference.feedforward import Feedforward
from calibration.inference.fit_notes import Remark as Remark
from calibration.inference.lack_of_fit import Adequacy
from calibration.inference.residual_clusters import ResidualCluster
from calibration.sensitivity.result import SensitivityResult
from calibration.words import experiment_words, fit_words, loop_words, sensitivity_words, step_words, table_words

#: Code of a remark → a sentence with its values, or a function that makes one.
NOTES: dict[str, str | Callable[..., str]] = {
    "step": step_words.step_sentence,
    "residual_cluster": lambda cluster: fit_words.residual_cluster(cluster),
    **table_words.SAID,
    **fit_words.SAID,
    **loop_words.SAID,
    **experiment_words.SAID,
    **sensitivity_words.SAID,
}
#: Kind of result, or part of one → the function that makes its sentence.
RESULTS: dict[type, Callable[..., str]] = {
    Feedforward: fit_words.feedforward_statement,
    fit_notes.DependentPair: fit_words.determined_combination,
    fit_notes.AdequacyFinding: fit_words.adequacy_finding_in_words,
    Adequacy: fit_words.adequacy_verdict,
    ResidualCluster: fit_words.residual_cluster,
    fit_results.CalibrationResult: lambda found: fit_words.adequacy_verdict(found.adequacy),
    fit_results.PriorSummary: lambda prior: fit_words.PRIORS.get(prior.source, prior.source),
    loop_notes.Headline: loop_words.loop_answer,
    loop_notes.VerdictSummary: loop_words.verdict_sentences,
    findings.RejectedCandidate: lambda found: loop_words.why_ruled_out(found.reasons),
    loop_results.DiscoveryResult: lambda found: loop_words.loop_answer(found.headline),
    formula.Proposal: lambda found: found.expression or loop_words.NO_FORMULA,
    findings.UnnamedDiscrepancy: loop_words.curve_course,
    SensitivityResult: sensitivity_words.sensitivity_statement,
    Settled: table_words.settle_statement,
}
#: The same of parts of results, by name.
PARTS: dict[tuple[type, str], Callable[..., str]] = {
    (fit_results.CalibrationResult, "header"): lambda found, robot_name: (
        f"calibrated from {robot_name} with {found.source}. The free parameters: {', '.join(found.parameters)}"
    ),
    (loop_results.DiscoveryResult, "header"): loop_words.proposed_header,
    (loop_results.DiscoveryResult, "refit header"): loop_words.refit_header,
    (loop_results.DiscoveryResult, "standing"): loop_words.naming_reasons,
}
