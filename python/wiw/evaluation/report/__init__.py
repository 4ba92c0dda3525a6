# SPDX-License-Identifier: Apache-2.0
"""A run as one HTML file that needs nothing else."""

from wiw.evaluation.report.page import summary_html, write_report

__all__ = ["summary_html", "write_report"]
