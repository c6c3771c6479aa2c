"""The functions that a patched script calls.

l1.py is ``l1_loss``, terms.py what a store's masks do to other terms, ``ssim`` and ``LEGSLoss``; state.py has the
settings of the process's run and finds the weight of a target, in memo.py, in stored.py or from the target.
"""

from legs_loss.counting import Counts as Counts
from legs_loss.runtime.l1 import l1_loss as l1_loss
from legs_loss.runtime.l1 import unweighted as unweighted
from legs_loss.runtime.state import active as active
from legs_loss.runtime.state import configure as configure
from legs_loss.runtime.state import counts as counts
