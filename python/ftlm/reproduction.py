"""The paper's section 5 recomputed: what it consists of, and the numbers its verdicts rest on."""

from ftlm.paper.asprinted import AsPrinted, as_printed, implied_spreads
from ftlm.paper.claims import Claim, printed_saturation, table_3_coefficients
from ftlm.paper.records import Candidate, Rival, Stage
from ftlm.paper.reproduction import Reproduction, reproduce
from ftlm.paper.unseen import Deflection, UnseenOrders, Verdict, orders_on_unseen_runs
from ftlm.paper.unseen_page import unseen_page

__all__ = ["AsPrinted", "Candidate", "Claim", "Deflection", "Reproduction", "Rival", "Stage", "UnseenOrders",
           "Verdict", "as_printed", "implied_spreads", "orders_on_unseen_runs", "printed_saturation", "reproduce",
           "table_3_coefficients", "unseen_page"]  # fmt: skip
