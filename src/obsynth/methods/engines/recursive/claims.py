"""Claims that the recursive methods share."""

from __future__ import annotations

from obsynth.methods.method import ClaimMeaning

RECURSIVE_CLAIMS = {
    "condition": ClaimMeaning("", "largest condition number of [E_k; C_k]", "claims"),
    "condition_k": ClaimMeaning("samples", "step at which it is", "claims"),
    "residual_directions": ClaimMeaning("", "least rank E_k + ny - nx: what the literal form (18) uses", "claims"),
    "contraction": ClaimMeaning("", "mean factor per step by which an error shrinks", "claims"),
    "steps": ClaimMeaning("samples", "steps that were checked", "claims"),
}
