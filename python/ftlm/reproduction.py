"""The paper's section 5 recomputed: what it consists of, and the numbers its verdicts rest on."""

from ftlm.paper.claims import Claim, implied_spreads, printed_saturation, table_3_coefficients
from ftlm.paper.records import Candidate, Rival, Stage
from ftlm.paper.reproduction import Reproduction, reproduce

__all__ = ["Candidate", "Claim", "Reproduction", "Rival", "Stage", "implied_spreads", "printed_saturation",
           "reproduce", "table_3_coefficients"]  # fmt: skip
