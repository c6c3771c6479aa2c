"""NerfBaselines: what it reads of the method ``splatfacto-legs``, from the file that NERFBASELINES_REGISTER names.

The folder has to be on PYTHONPATH. Only NerfBaselines is imported, so that ``nerfbaselines train --help`` lists the
method where nerfstudio is missing.
"""

from nerfbaselines import register

register(
    {
        "id": "splatfacto-legs",
        "method_class": "splatfacto_legs:SplatfactoLegs",
        "metadata": {
            "name": "Splatfacto with the LEGS loss",
            "description": "nerfstudio's splatfacto, its L1 weighted towards contours and thin structures.",
            "paper_title": "Laplacian-Enhanced Gaussian Splatting with a Nonlinear Weighted Loss",
            "licenses": [{"name": "Apache 2.0"}],
        },
        "implementation_status": {},
    }
)
