import json
import time

import numpy as np
import pytest

from dine.data.layout import check_pair, scan
from dine.errors import DataError
from dine.geometry.surface import Surface


@pytest.fixture
def make(tmp_path):
    """Makes empty files below a fresh folder; ``scan`` never opens surfaces."""

    def files(*names, root="dataset"):
        for name in names:
            path = tmp_path / root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        return tmp_path / root

    return files


def pair(folder, name="1_5_0.3", suffix=".ply"):
    return [f"{folder}/{role}_{name}{suffix}" for role in ("Source", "Target")]


def numbers(inventory):
    return [(p.condition, p.corruption, p.level) for p in inventory.pairs]


def reasons(inventory):
    return {path.name: reason for path, reason in inventory.left_out}


def test_the_described_layout(make):
    folder = make(
        "Data/1.ply",
        "Data/2.ply",
        *pair("Deformation_Level/0.1"),
        *pair("Deformation_Level/0.10", "2_10_0.5"),
        *pair("Noisy_Data/0.01/0.1"),
        *pair("Outlier_Data/5/0.1"),
        "Outlier_Data/5/0.1/Outlier_1_5_0.3.ply",
    )
    found = scan(folder)
    assert found.has_pairs
    assert sorted(found.bases) == ["1", "2"]
    assert found.left_out == []
    assert numbers(found) == [
        ("deformation", None, 0.1),
        ("deformation", None, 0.1),
        ("noise", 0.01, 0.1),
        ("outliers", 5.0, 0.1),
    ]
    last = found.pairs[-1]
    assert (last.object, last.name, last.control_percent, last.width) == ("1", "1_5_0.3", 5.0, 0.3)
    assert last.source == folder / "Outlier_Data/5/0.1/Source_1_5_0.3.ply"
    assert last.target == folder / "Outlier_Data/5/0.1/Target_1_5_0.3.ply"
    assert last.outliers == folder / "Outlier_Data/5/0.1/Outlier_1_5_0.3.ply"
    assert found.pairs[0].outliers is None
    table = found.table()
    assert list(table.columns) == ["condition", "corruption", "level", "pairs", "objects"]
    assert table["pairs"].tolist() == [2, 1, 1]
    assert table["objects"].tolist() == [2, 1, 1]


@pytest.mark.parametrize(
    ("folder", "expected"),
    [
        ("Deformation_Level/Level_0.3", ("deformation", None, 0.3)),
        ("deformation level/level-0,3", ("deformation", None, 0.3)),
        ("DEFORMATION-LEVELS/0.3", ("deformation", None, 0.3)),
        ("Deformation_Level_0.3", ("deformation", None, 0.3)),
        ("SynBench2/Deformation_Level/0.3", ("deformation", None, 0.3)),
        ("Deformation_Level/0.3/meshes", ("deformation", None, 0.3)),
        ("0.3", ("deformation", None, 0.3)),
        (".", ("deformation", None, None)),
        ("Noisy_Data/0.02", ("noise", 0.02, None)),
        ("noisy data/noise0.02/0.3", ("noise", 0.02, 0.3)),
        ("Noisy_Data/Deformation_0.3/0.02", ("noise", 0.02, 0.3)),
        ("Noisy_Data/0.02/Deformation_Level/0.3", ("noise", 0.02, 0.3)),
        ("Deformation_Level/0.3/Noisy_Data/0.02", ("noise", 0.02, 0.3)),
        ("Level_0.3/Noisy_Data/0.02", ("noise", 0.02, 0.3)),
        ("Outlier_Data/5%", ("outliers", 5.0, None)),
        ("Outlier-Data/0.3/5%", ("outliers", 5.0, 0.3)),
        ("outlierdata/percent_5/patient12/0.3", ("outliers", 5.0, 0.3)),
        ("Incompleteness_Data", ("incompleteness", None, None)),
        ("Incompleteness Data/10 %/0.3", ("incompleteness", 10.0, 0.3)),
    ],
)
def test_condition_and_level_come_from_any_folder_name(make, folder, expected):
    root = make(*pair(folder))
    assert numbers(scan(root)) == [expected]


def test_two_unnamed_numbers_are_corruption_then_level(make):
    folder = make(*pair("Deformation_Level/0.1"), *pair("Noisy_Data/0.01/0.1"))
    assert numbers(scan(folder))[1] == ("noise", 0.01, 0.1)


def test_known_levels_outside_change_places_with_the_corruption(make):
    # 0.3 is a level of the dataset and 0.01 is not, so here the outer folders are the levels.
    folder = make(*pair("Deformation_Level/0.3"), *pair("Noisy_Data/0.3/0.01"))
    assert numbers(scan(folder))[1] == ("noise", 0.01, 0.3)


def test_a_single_number_of_incompleteness_may_be_a_level(make):
    known = make(*pair("Deformation_Level/0.3"), *pair("Incompleteness_Data/0.3"), root="a")
    assert numbers(scan(known))[1] == ("incompleteness", None, 0.3)
    other = make(*pair("Deformation_Level/0.3"), *pair("Incompleteness_Data/20"), root="b")
    assert numbers(scan(other))[1] == ("incompleteness", 20.0, None)


def test_scanning_below_the_condition_folder(make):
    folder = make(*pair("Noisy_Data/0.02/0.3"))
    expected = [("noise", 0.02, 0.3)]
    assert numbers(scan(folder / "Noisy_Data")) == expected
    assert numbers(scan(folder / "Noisy_Data/0.02/0.3")) == expected


def test_names(make):
    folder = make(
        "Data/RC_1.ply",
        "Data/7.ply",
        "0.1/source-RC_1_5_0.3.OBJ",
        "0.1/TARGET RC_1_5_0.3.OBJ",
        *pair("0.1", "7_smooth"),
        *pair("0.1", "9_5%_0,30"),
    )
    found = {p.name: (p.object, p.control_percent, p.width) for p in scan(folder).pairs}
    assert found == {
        "RC_1_5_0.3": ("RC_1", 5.0, 0.3),
        "7_smooth": ("7", None, None),
        "9_5%_0,30": ("9", 5.0, 0.3),
    }


def test_what_is_left_out_and_why(make):
    folder = make(
        *pair("Deformation_Level/0.1"),
        *pair("Deformation_Level/strong", "2_5_0.3"),
        "Deformation_Level/0.1/Source_3_5_0.3.ply",
        "Deformation_Level/0.1/Target_4_5_0.3.ply",
        "Deformation_Level/0.1/Outlier_9_5_0.3.ply",
        "Deformation_Level/0.1/Source_1_5_0.3.xyz",
        "Deformation_Level/0.1/Target_1_5_0.3.xyz",
        "Deformation_Level/0.1/extra.ply",
        "Deformation_Level/0.1/5.triangle",
        *pair("Noisy_Data", "6_5_0.3"),
        *pair("Noisy_Data/Outlier_Data/5", "7_5_0.3"),
        *pair("Noisy_Data/0.1/0.2/0.3", "8_5_0.3"),
        "Data/1.ply",
        "Data/1.obj",
        "Data/README.txt",
        "Data/measured.csv",
        "Data.zip",
        "photo.jpg",
        "stray.ply",
        ".git/config",
        ".notes",
    )
    found = scan(folder)
    assert [p.target.name for p in found.pairs] == ["Target_1_5_0.3.ply"]
    assert found.bases == {"1": folder / "Data/1.ply"}
    assert found.left_out == sorted(found.left_out)
    why = reasons(found)
    for name, words in {
        "Source_2_5_0.3.ply": "'strong' is not a number",
        "Target_2_5_0.3.ply": "'strong' is not a number",
        "Source_3_5_0.3.ply": "no Target_ file",
        "Target_4_5_0.3.ply": "no Source_ file",
        "Outlier_9_5_0.3.ply": "no Target_ file",
        "Source_1_5_0.3.xyz": "the same as Source_1_5_0.3.ply",
        "Target_1_5_0.3.xyz": "the same as Target_1_5_0.3.ply",
        "extra.ply": "neither in a Data folder",
        "5.triangle": "without an .xyz",
        "Target_6_5_0.3.ply": "'Noisy_Data' is not a number",
        "Target_7_5_0.3.ply": "two conditions (noise and outliers)",
        "Target_8_5_0.3.ply": "more numbers",
        "1.obj": "the same object as 1.ply",
        "README.txt": "documentation",
        "measured.csv": "beside mesh files",
        "Data.zip": "an archive",
        "photo.jpg": "suffix '.jpg'",
        "stray.ply": "neither in a Data folder",
        ".git": "hidden",
        ".notes": "hidden",
    }.items():
        assert words in why.pop(name), name
    assert set(why) == {"Source_6_5_0.3.ply", "Source_7_5_0.3.ply", "Source_8_5_0.3.ply"}


def test_every_file_is_used_or_left_out_exactly_once(make):
    names = [
        *pair("Deformation_Level/0.1"),
        *pair("Deformation_Level/0.1", suffix=".xyz"),
        "Noisy_Data/0.01/0.1/Target_1_5_0.3.ply",
        "Noisy_Data/0.01/0.1/Target_1_5_0.3.off",
        "Outlier_Data/5/0.1/Outlier_1_5_0.3.ply",
        "Data/1.ply",
        "Data/1.stl",
        "manifest.json",
    ]
    folder = make(*names)
    found = scan(folder)
    used = set(found.bases.values())
    for p in found.pairs:
        used |= {p.source, p.target, p.outliers} - {None}
    listed = [path for path, _ in found.left_out]
    assert len(listed) == len(set(listed))
    assert used.isdisjoint(listed)
    assert used | set(listed) == {folder / name for name in names}


def test_formats_of_one_pair_are_not_mixed(make):
    folder = make("0.1/Source_1.xyz", "0.1/Target_1.xyz", "0.1/Target_1.ply")
    (only,) = scan(folder).pairs
    assert (only.source.suffix, only.target.suffix) == (".xyz", ".xyz")


def test_a_noisy_target_borrows_the_source_of_its_level(make):
    folder = make(
        *pair("Deformation_Level/0.1"),
        *pair("Deformation_Level/0.2"),
        "Noisy_Data/0.01/0.2/Target_1_5_0.3.ply",
        "Noisy_Data/0.02/Target_1_5_0.3.ply",
        "Noisy_Data/0.01/0.7/Target_1_5_0.3.ply",
    )
    found = scan(folder)
    (noisy,) = [p for p in found.pairs if p.condition == "noise"]
    assert (noisy.corruption, noisy.level) == (0.01, 0.2)
    assert noisy.source == folder / "Deformation_Level/0.2/Source_1_5_0.3.ply"
    # Without a level two sources fit, and at 0.7 none does.
    assert [path.parent.name for path, _ in found.left_out] == ["0.7", "0.02"]


def test_same_names_in_two_collections_stay_apart(make):
    folder = make(
        "RC/Data/1.ply",
        "CT/Data/1.ply",
        *pair("RC/Deformation_Level/0.1"),
        *pair("CT/Deformation_Level/0.1"),
        "CT/Noisy_Data/0.01/0.1/Target_1_5_0.3.ply",
    )
    found = scan(folder)
    assert sorted(found.bases) == ["CT__Data__1", "RC__Data__1"]
    assert [p.object for p in found.pairs] == ["CT__Data__1", "RC__Data__1", "CT__Data__1"]
    assert all(p.source.is_relative_to(folder / p.object[:2]) for p in found.pairs)


def test_source_and_target_folders(make):
    folder = make("0.1/Source/Source_1.ply", "0.1/Target/Target_1.ply")
    assert numbers(scan(folder)) == [("deformation", None, 0.1)]


def test_a_folder_of_meshes(make):
    folder = make("a.ply", "sub/b.stl", "x/c.off", "y/c.off", "index.csv", "SOURCES.md")
    found = scan(folder)
    assert not found.has_pairs
    assert found.table().empty
    assert found.bases == {
        "a": folder / "a.ply",
        "b": folder / "sub/b.stl",
        "x__c": folder / "x/c.off",
        "y__c": folder / "y/c.off",
    }
    assert set(reasons(found)) == {"index.csv", "SOURCES.md"}


def test_a_folder_of_tables_and_simtool_files(make):
    assert sorted(scan(make("a.txt", "b.csv", root="t")).bases) == ["a", "b"]
    simtool = scan(make("a.xyz", "a.triangle", root="s"))
    assert (sorted(simtool.bases), simtool.left_out) == (["a"], [])


def test_links_are_followed_once(make):
    folder = make("real/a.ply")
    (folder / "real/loop").symlink_to(folder)
    found = scan(folder)
    assert list(found.bases) == ["a"]
    assert "scanned already" in reasons(found)["loop"]


def test_nothing_usable(make, tmp_path):
    with pytest.raises(DataError, match="missing is not a folder; expected"):
        scan(tmp_path / "missing")
    with pytest.raises(DataError, match=r"notes\.ply is not a folder"):
        scan(make("notes.ply") / "notes.ply")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"nothing usable \(it is empty\); expected Source_"):
        scan(tmp_path / "empty")
    with pytest.raises(DataError, match="1 x an archive"):
        scan(make("all.zip", root="zipped"))
    with pytest.raises(DataError, match="1 x no Target_ file"):
        scan(make("Source_1.ply", root="half"))


def test_scanning_is_quick(make):
    folder = make()
    for level in range(1, 5):
        (folder / f"Deformation_Level/0.{level}").mkdir(parents=True)
        for number in range(500):
            for name in pair(f"Deformation_Level/0.{level}", f"{number}_5_0.3"):
                (folder / name).touch()
    start = time.perf_counter()
    assert len(scan(folder).pairs) == 2000
    assert time.perf_counter() - start < 4  # takes 0.1 s; anything quadratic takes far longer


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("split.json", json.dumps({"train": [1], "validation": ["2"], "test": ["3"]})),
        ("official_split.json", json.dumps({"1": "train", "2": "val", "3": "Test"})),
        ("split.csv", "object, split\n1, train\n2, valid\n3, test\n"),
        ("lists/my-split.csv", "\ufeffsplit,extra,name\ntrain,x,1\nval,y,2\ntest,z,3\n"),
        (
            "split.json",
            json.dumps(
                {
                    "train": ["Data/1.ply"],
                    "val": ["Source_2.ply", "Target_2.xyz"],
                    "test": ["x\\3.obj"],
                }
            ),
        ),
    ],
)
def test_split_files(make, file, text):
    folder = make("Data/1.ply", "Data/2.ply", "Data/3.ply", *pair("Deformation_Level/0.1"), file)
    (folder / file).write_text(text, encoding="utf-8")
    found = scan(folder)
    assert found.split == {"1": "train", "2": "val", "3": "test"}
    assert found.split_file == folder / file
    assert found.left_out == []


def test_split_lists_with_pair_names(make):
    folder = make(
        *pair("0.1", "1_5_0.3"),
        *pair("0.1", "2_5_0.3"),
        *("splits/train_files.txt", "splits/valid_split.txt", "splits/test.txt"),
    )
    (folder / "splits/train_files.txt").write_text("# names\n0.1/Source_1_5_0.3.ply\n\n")
    (folder / "splits/valid_split.txt").write_text("9_5_0.3\n")
    (folder / "splits/test.txt").write_text("Target_2_5_0.3\n")
    found = scan(folder)
    assert found.split == {"0.1/1_5_0.3": "train", "9_5_0.3": "val", "2_5_0.3": "test"}
    assert found.split_file == folder / "splits/test.txt"


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("split.json", '{"train": ["0.1/1_5_0.3"], "test": ["0.2/1_5_0.3"]}'),
        ("split.json", '{"0.1/1_5_0.3": "train", "0.2/Target_1_5_0.3": "test"}'),
        (
            "split.json",
            json.dumps(
                {
                    "train": ["Deformation_Level/0.1/Source_1_5_0.3.ply"],
                    "test": ["noise\\dataset\\Deformation_Level\\0.2\\Target_1_5_0.3.ply"],
                }
            ),
        ),
        ("split.csv", "level,name,split\n0.1,1_5_0.3,train\n0.2,1_5_0.3,test\n"),
    ],
)
def test_split_files_tell_pairs_of_one_name_apart_by_level(make, file, text):
    folder = make(*pair("Deformation_Level/0.1"), *pair("Deformation_Level/0.2"), file)
    (folder / file).write_text(text)
    found = scan(folder)
    assert found.split == {"0.1/1_5_0.3": "train", "0.2/1_5_0.3": "test"}
    assert {files.id for files in found.pairs} == set(found.split)


def test_a_level_may_be_missing_in_a_split_file(make):
    folder = make(*pair("0.1"), *pair("0.2", "2_5_0.3"), "split.csv")
    (folder / "split.csv").write_text("level,name,split\n0.1,1_5_0.3,train\n,2_5_0.3,test\n")
    assert scan(folder).split == {"0.1/1_5_0.3": "train", "2_5_0.3": "test"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"train": ["1_5_0.3"], "test": ["1_5_0.3"]}', "in train and in test .*by their level"),
        ('{"train": ["0.9/1_5_0.3"]}', "names none of the objects and pairs found"),
    ],
)
def test_splits_that_tell_pairs_wrongly(make, text, message):
    folder = make(*pair("0.1"), *pair("0.2"), "split.json")
    (folder / "split.json").write_text(text)
    with pytest.raises(DataError, match=message):
        scan(folder)


def test_one_of_several_split_files_is_used(make):
    folder = make("1.ply", "split.json", "sub/split.json", "train.txt", "a/b/split.json")
    (folder / "split.json").write_text('{"1": "test"}')
    found = scan(folder)
    assert found.split_file == folder / "split.json"
    why = {str(path.relative_to(folder)): reason for path, reason in found.left_out}
    assert "another split file" in why["sub/split.json"]
    assert "another split file" in why["train.txt"]
    assert "suffix" in why["a/b/split.json"]


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("split.json", "{", "split.json is not readable JSON"),
        ("split.json", "[1]", "split.json .*not a JSON object"),
        ("split.json", "{}", "split.json .*holds no names"),
        ("split.json", '{"train": ["1"], "test": "2"}', "mixes lists"),
        ("split.json", '{"train": ["1"], "test": ["1"]}', "1 is in train and in test"),
        ("split.json", '{"fold3": ["1"]}', "'fold3' is none of"),
        ("split.json", '{"1": 4}', "4 is none of"),
        ("split.json", '{"train": [null]}', "None is not a name"),
        ("split.json", '{"train": ["/"]}', "'/' is not a name"),
        ("split.json", '{"train": ["77"]}', "names none of the objects"),
        ("split.csv", "", "no rows, or no columns"),
        ("split.csv", "name,part\n1,train\n", "no rows, or no columns"),
        ("split.csv", "name,split\n1\n", "None is none of"),
        ("split.csv", "level,name,split\n0.1,,train\n", "'' is not a name"),
        ("split.csv", "split,level,name\ntrain,0.1\n", "None is not a name"),
        ("train.txt", "\n", "train.txt .*holds no names"),
    ],
)
def test_malformed_split_files(make, file, text, message):
    folder = make("1.ply", "2.ply", file)
    (folder / file).write_text(text)
    with pytest.raises(DataError, match=message):
        scan(folder)


def test_a_split_file_that_is_not_text(make):
    folder = make("1.ply", "test.txt")
    (folder / "test.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match=r"test\.txt .*cannot be read as text"):
        scan(folder)


def test_check_pair():
    rng = np.random.default_rng(0)
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    source, target = (Surface(rng.normal(size=(4, 3)), faces) for _ in range(2))
    check_pair(source, target, "1")
    check_pair(source, Surface(target.vertices), "1")
    with pytest.raises(DataError, match=r"1_5_0\.3: the source has 4 vertices and the target 3"):
        check_pair(source, Surface(target.vertices[:3]), "1_5_0.3")
    with pytest.raises(DataError, match=r"1_5_0\.3: .*different faces"):
        check_pair(source, Surface(target.vertices, faces[:, ::-1]), "1_5_0.3")
    with pytest.raises(DataError, match="different faces"):
        check_pair(source, Surface(target.vertices, faces[:1]), "1")


# --- manifests ------------------------------------------------------------------------------------


def test_a_manifest_lists_pairs_of_any_name(make):
    folder = make("scans/before.ply", "scans/after.ply", "other/after.ply")
    manifest = folder / "pairs.csv"
    manifest.write_text(
        "source,target,level,object,name\n"
        "scans/before.ply,scans/after.ply,0.1,,\n"
        "scans/before.ply,other/after.ply,0.25,liver,second\n"
    )
    found = scan(manifest)
    assert numbers(found) == [("deformation", None, 0.1), ("deformation", None, 0.25)]
    assert [p.object for p in found.pairs] == ["scans/before.ply", "liver"]
    assert [p.name for p in found.pairs] == ["before_to_after", "second"]
    assert found.pairs[1].target == folder / "other/after.ply"
    assert found.folder == folder


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("", "lists no pairs"),
        ("a.ply,missing.ply,0.1\n", "missing.ply, which is not there"),
        ("a.ply,a.ply,strong\n", "row 1: the level is 'strong'"),
        ("a.ply,a.ply,nan\n", "row 1: the level is 'nan'"),
        ("a.ply,a.ply,-1\n", "row 1: the level is '-1'"),
        ("a.ply,,1\n", "row 1: expected a source, a target"),
    ],
)
def test_bad_manifests(make, rows, said):
    manifest = make("a.ply") / "pairs.csv"
    manifest.write_text(f"source,target,level\n{rows}")
    with pytest.raises(DataError, match=said):
        scan(manifest)
