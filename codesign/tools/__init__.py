"""Design without a controller: metrics of a body, their sensitivity, search, gradients, and calibration from data.

All of it reads the condensed model alone (thesis, sections 3.2 to 3.4 and 4.5), on FEM or on a learned surrogate.
"""
