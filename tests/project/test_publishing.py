"""What is published: the page on a package index, the release workflow, and the article."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import pytest
import yaml

import robsmooth
from docs import package_page

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
VERSION = tomllib.loads(PROJECT)["project"]["version"]
TAG = f"v{VERSION}"
ANY_LINK = re.compile(r"\]\(([^)\s]+)\)")


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    for name in ("README.md", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_link_of_the_page_on_an_index_is_absolute_and_leads_to_a_file(checkout):
    package_page.main(["someone/robsmooth", TAG])
    page = (checkout / "README.md").read_text(encoding="utf-8")
    found = ANY_LINK.findall(page)
    assert len(found) == len(ANY_LINK.findall(README)) > 20
    for address in found:
        assert re.match(r"https?://", address)
        for home in (f"github.com/someone/robsmooth/blob/{TAG}/", f"someone/robsmooth/{TAG}/"):
            path, _, heading = address.partition(home)[2].partition("#")
            assert (ROOT / path).exists()
            if heading:
                text = (ROOT / path).read_text(encoding="utf-8").lower().replace(" ", "-")
                assert f"#-{heading}\n" in text
    images = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page)
    assert images and all(each.startswith("https://raw.githubusercontent.com/") for each in images)


def test_an_absolute_link_and_a_heading_of_the_page_stay_as_they_are():
    text = "[a](https://example.org) [b](#speed) [c](mailto:a@b.c)"
    assert package_page.absolute(text, "someone/robsmooth", TAG) == text


def test_the_project_names_its_addresses(checkout):
    package_page.main(["someone/robsmooth", TAG])
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["urls"]["Source"] == "https://github.com/someone/robsmooth"
    assert project["urls"]["Changelog"].endswith(f"/blob/{TAG}/CHANGELOG.md")


def test_a_tag_that_is_not_the_version_is_refused_and_changes_nothing(checkout, capsys):
    with pytest.raises(SystemExit):
        package_page.main(["someone/robsmooth", "v0.0.1"])
    assert f"tag must be {TAG}, the version in pyproject.toml, got 'v0.0.1'" in (
        capsys.readouterr().err
    )
    assert (checkout / "README.md").read_text(encoding="utf-8") == README


def test_version_citation_and_changelog_agree():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == VERSION == robsmooth.__version__
    assert f"\n## {VERSION}\n" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_every_action_of_the_workflows_is_pinned_by_its_commit():
    used = []
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        used += re.findall(r"uses: (\S+)", path.read_text(encoding="utf-8"))
    assert used
    assert all(re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", each) for each in used)


def test_the_image_of_the_development_container_is_pinned_by_its_digest():
    container = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8"))
    assert re.fullmatch(r"[\w./-]+:3\.11\S*@sha256:[0-9a-f]{64}", container["image"])


def test_only_the_jobs_that_publish_have_more_than_the_right_to_read():
    workflow = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))
    assert workflow["permissions"] == {"contents": "read"}
    assert {name for name, job in workflow["jobs"].items() if "permissions" in job} == {
        "publish",
        "deploy",
    }


def test_what_no_lock_has_is_installed_only_where_nothing_is_published_or_kept():
    workflow = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))
    jobs, unlocked = workflow["jobs"], set()
    for name, job in jobs.items():
        for run in (step.get("run", "") for step in job["steps"]):
            if re.search(r"\bpip install", run) and "--require-hashes" not in run:
                unlocked.add(name)
    assert unlocked == {"check"}
    assert {*jobs["publish"]["needs"]} == {"build", "check"}
    assert "upload" not in str(jobs["check"]) and "permissions" not in jobs["check"]


SECTIONS = [  # that the journal asks for, in this order
    "Summary",
    "Statement of need",
    "State of the field",
    "Software design",
    "Research impact statement",
    "AI usage disclosure",
    "Acknowledgements",
    "References",
]


def test_the_article_has_the_scorecard_of_the_readme_and_cites_what_its_list_has():
    article = (ROOT / "paper.md").read_text(encoding="utf-8")
    _, _, rest = README.partition("<!-- scorecard: written by make figures -->\n")
    scorecard, _, _ = rest.partition("\n<!-- end of scorecard -->")
    assert scorecard.startswith("Of 1") and scorecard in article
    cited = set(re.findall(r"@(\w+)", article.partition("# Summary")[2]))
    listed = set(re.findall(r"^@\w+\{(\w+),", (ROOT / "paper.bib").read_text(), flags=re.MULTILINE))
    assert cited == listed
    words = len(article.partition("# Summary")[2].split())
    assert 750 <= words <= 1750  # as the journal asks
    assert re.findall(r"^# (.+)$", article, flags=re.MULTILINE) == SECTIONS


def test_binder_installs_the_lock():
    assert (ROOT / ".binder/requirements.txt").read_text() == "-r ../requirements.lock\n"
    assert (ROOT / ".binder/postBuild").stat().st_mode & 0o111
    assert (ROOT / ".binder/runtime.txt").read_text() == "python-3.11\n"
