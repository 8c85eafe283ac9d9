// Stand-ins for what the Unity client of docs/agents.md uses of Unity and of NetMQ. Messages go out by the standard output
// and come in by the standard input, a line each: the parts in hexadecimal, with blanks between. A line "V ..." tells what
// the client shows: the pelvis (x, y, z and x, y, z, w) and the first joint (x, y, z, w).
using System; using System.Collections.Concurrent; using System.Collections.Generic; using System.Globalization;
using System.Linq; using System.Reflection; using System.Text; using System.Text.RegularExpressions; using System.Threading;

namespace AsyncIO { public static class ForceDotNet { public static void Force() {} } }

namespace UnityEngine {
    public class MonoBehaviour {}
    public struct Vector3 {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
    }
    public struct Quaternion {
        public float x, y, z, w;
        public Quaternion(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }
    }
    public class Transform {
        public Vector3 position { get; set; }
        public Quaternion rotation { get; set; } = new Quaternion(0, 0, 0, 1);
        public Quaternion localRotation { get; set; } = new Quaternion(0, 0, 0, 1);
    }
    public static class Mathf { public static float Max(float a, float b) => Math.Max(a, b); }
    public static class Time {
        static readonly System.Diagnostics.Stopwatch watch = System.Diagnostics.Stopwatch.StartNew();
        public static float time => (float)watch.Elapsed.TotalSeconds;
    }
    public static class JsonUtility {
        public static T FromJson<T>(string text) where T : new() {
            object made = new T();
            foreach (var field in typeof(T).GetFields()) {
                var found = Regex.Match(text, "\"" + field.Name + "\": ?(?:\"([^\"]*)\"|(-?[0-9]+))");
                if (found.Success) field.SetValue(made, Convert.ChangeType(found.Groups[1].Value + found.Groups[2].Value, field.FieldType));
            }
            return (T)made;
        }
    }
}

namespace NetMQ {
    public class NetMQFrame {
        readonly byte[] bytes;
        public NetMQFrame(byte[] bytes) { this.bytes = bytes; }
        public string ConvertToString() => Encoding.UTF8.GetString(bytes);
        public byte[] ToByteArray() => bytes;
    }
    public class NetMQMessage {
        public readonly List<NetMQFrame> Frames = new List<NetMQFrame>();
        public NetMQFrame this[int index] => Frames[index];
        public void Append(byte[] part) => Frames.Add(new NetMQFrame(part));
    }
    public static class NetMQConfig { public static void Cleanup(bool block) {} }
}

namespace NetMQ.Sockets {
    public class PublisherSocket : IDisposable {
        public void Bind(string address) {}
        public void SendMultipartMessage(NetMQMessage message) =>
            Console.WriteLine("S " + string.Join(" ", message.Frames.Select(each => "." + BitConverter.ToString(each.ToByteArray()).Replace("-", ""))));
        public void Dispose() {}
    }
    public class SubscriberSocket : IDisposable {
        public static readonly ConcurrentQueue<string> Come = new ConcurrentQueue<string>();
        public void Connect(string address) {}
        public void Subscribe(string topic) {}
        public bool TryReceiveMultipartMessage(ref NetMQMessage message, int count) {
            if (!Come.TryDequeue(out var line)) return false;
            message = new NetMQMessage();
            foreach (var part in line.Split(' '))
                message.Append(Enumerable.Range(0, part.Length / 2).Select(n => Convert.ToByte(part.Substring(1 + 2 * n, 2), 16)).ToArray());
            return true;
        }
        public void Dispose() {}
    }
}

public static class Play {
    static void Call(object one, string name) =>
        one.GetType().GetMethod(name, BindingFlags.Instance | BindingFlags.NonPublic).Invoke(one, null);

    public static void Main(string[] words) {
        CultureInfo.CurrentCulture = CultureInfo.InvariantCulture;
        Console.SetOut(new System.IO.StreamWriter(Console.OpenStandardOutput()) { AutoFlush = true });
        var agent = new MagnetAgent { pelvis = new UnityEngine.Transform(), ownPelvis = new UnityEngine.Transform() };
        for (var j = 0; j < 21; j++) {
            agent.joints[j] = new UnityEngine.Transform();
            agent.ownJoints[j] = new UnityEngine.Transform { localRotation = new UnityEngine.Quaternion(0, 0.6f, 0, 0.8f) };
        }
        agent.ownPelvis.position = new UnityEngine.Vector3(-1, 0.95f, 2);
        agent.ownPelvis.rotation = new UnityEngine.Quaternion(0.6f, 0, 0, 0.8f);
        var ended = false;
        new Thread(() => {
            for (string line; (line = Console.ReadLine()) != null;) NetMQ.Sockets.SubscriberSocket.Come.Enqueue(line);
            ended = true;
        }) { IsBackground = true }.Start();
        Call(agent, "Start");
        while (!ended) {
            Call(agent, "Update");
            var p = agent.pelvis.position; var r = agent.pelvis.rotation; var j = agent.joints[0].localRotation;
            Console.WriteLine("V " + string.Join(" ", new[] { p.x, p.y, p.z, r.x, r.y, r.z, r.w, j.x, j.y, j.z, j.w }));
            Thread.Sleep(5);
        }
        Call(agent, "OnDestroy");
    }
}
