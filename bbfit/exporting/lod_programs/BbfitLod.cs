// Makes a prefab with a LODGroup of what `bbfit lod` wrote, for Unity with the package glTFast. Nobody has tried it yet.
// Put it into a folder named Editor, and the level files with lod.json into Assets. Select lod.json, then Assets, Create prefab of bbfit.
using System;
using System.IO;
using System.Linq;
using UnityEditor;
using UnityEngine;

public static class BbfitLod
{
    [Serializable] class Level { public string file; public float distance_meters; }
    [Serializable] class Config { public float screen_fov_degrees; }
    [Serializable] class Document { public string name; public Config config; public Level[] levels; }

    [MenuItem("Assets/Create prefab of bbfit")]
    static void Create()
    {
        string path = AssetDatabase.GetAssetPath(Selection.activeObject), folder = Path.GetDirectoryName(path);
        var document = JsonUtility.FromJson<Document>(File.ReadAllText(path));
        var tree = new GameObject(document.name);
        var group = tree.AddComponent<LODGroup>();
        var lods = document.levels.Select(level =>
        {
            var asset = AssetDatabase.LoadAssetAtPath<GameObject>(Path.Combine(folder, level.file));
            var child = (GameObject)PrefabUtility.InstantiatePrefab(asset, tree.transform);
            child.name = Path.GetFileNameWithoutExtension(level.file); // NAME_LOD0 and so on
            return new LOD(0, child.GetComponentsInChildren<Renderer>()) { fadeTransitionWidth = 0.1f };
        }).ToArray();
        // Each level ends where the next one begins: at the share of the screen's height that the group has there. Bounds come first.
        for (int i = 0; i < lods.Length; i++) lods[i].screenRelativeTransitionHeight = 1f - (i + 1f) / (lods.Length + 1f);
        group.SetLODs(lods);
        group.RecalculateBounds();
        float half = Mathf.Tan(document.config.screen_fov_degrees * Mathf.Deg2Rad / 2);
        for (int i = 0; i < lods.Length; i++)
            lods[i].screenRelativeTransitionHeight = i + 1 < lods.Length ? group.size / (2 * half * document.levels[i + 1].distance_meters) : 0;
        group.fadeMode = LODFadeMode.CrossFade;
        group.SetLODs(lods);
        PrefabUtility.SaveAsPrefabAsset(tree, Path.Combine(folder, document.name + ".prefab"));
        UnityEngine.Object.DestroyImmediate(tree);
    }
}
