BEGIN TRANSACTION;
CREATE TABLE captures (
        id TEXT PRIMARY KEY, document TEXT NOT NULL,
        state TEXT GENERATED ALWAYS AS (json_extract(document, '$.state')) VIRTUAL,
        deleted_at TEXT GENERATED ALWAYS AS (json_extract(document, '$.deleted_at')) VIRTUAL
    ) WITHOUT ROWID;
INSERT INTO "captures" VALUES('01a20d8c-a46e-7433-a257-359fd21d4f2b','{"id":"01a20d8c-a46e-7433-a257-359fd21d4f2b","origin":"live","plan":{"source":"sim:?seed=1","frames":null,"seconds":null,"pretrigger_s":0.0,"name":"","notes":"","record":true,"reconstruct":true,"options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"intrinsics":null},"state":"complete","started_at":"2026-11-21T07:10:00.123456Z","name":"Wohnzimmer","notes":"","keep":false,"reason":"","warnings":[],"sensor":{"width":400,"height":250,"frame_rate_hz":20000.0,"layout":"compact","bit_order":"lsb","flipped":true,"mosaic":null,"intrinsics":null,"response":"integrate-and-fire"},"frames_planned":null,"recording":{"frames":100,"bytes":1250000,"first_frame":0,"lost":0,"lost_by_cause":{},"sha256":null},"verdict":{"grade":"degraded","reasons":["5 frames were lost"]},"counters":null,"ended_at":"2026-11-21T07:10:00.123456Z","deleted_at":null,"group":"01a20d8c-a46e-72b1-8282-496da2e1e3eb"}');
INSERT INTO "captures" VALUES('01a20d8c-a46e-75c1-be8f-097edaace674','{"id":"01a20d8c-a46e-75c1-be8f-097edaace674","origin":"live","plan":{"source":"sim:?seed=1","frames":null,"seconds":null,"pretrigger_s":0.0,"name":"","notes":"","record":true,"reconstruct":true,"options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"intrinsics":null},"state":"failed","started_at":"2026-11-21T07:10:00.123456Z","name":"Küche","notes":"","keep":false,"reason":"","warnings":[],"sensor":null,"frames_planned":null,"recording":null,"verdict":null,"counters":null,"ended_at":"2026-11-21T07:10:00.123456Z","deleted_at":"2026-11-21T07:10:00.123456Z","group":null}');
CREATE TABLE history (schema INTEGER PRIMARY KEY, at TEXT NOT NULL, program TEXT NOT NULL);
INSERT INTO "history" VALUES(2,'2026-11-27T11:03:47.396884+00:00','0.2.0');
INSERT INTO "history" VALUES(3,'2026-11-27T18:23:42.606681+00:00','0.2.0');
CREATE TABLE queue (
        urgency INTEGER NOT NULL, turn TEXT NOT NULL, id TEXT NOT NULL UNIQUE, held INTEGER NOT NULL,
        user TEXT NOT NULL, PRIMARY KEY (urgency, turn, id)
    ) WITHOUT ROWID;
INSERT INTO "queue" VALUES(-7,'01a20d8c-a472-7333-8333-333333333333','01a20d8c-a472-7333-8333-333333333333',0,'');
INSERT INTO "queue" VALUES(0,'01a20d8c-a46e-765c-b741-84ea5074fa1e','01a20d8c-a46e-765c-b741-84ea5074fa1e',0,'');
INSERT INTO "queue" VALUES(0,'01a20d8c-a470-7111-8111-111111111111','01a20d8c-a471-7222-8222-222222222222',1,'');
INSERT INTO "queue" VALUES(0,'01a20d8c-a471-7222-8222-222222222222','01a20d8c-a470-7111-8111-111111111111',0,'');
CREATE TABLE reconstructions (
        id TEXT PRIMARY KEY, document TEXT NOT NULL,
        capture_id TEXT GENERATED ALWAYS AS (json_extract(document, '$.capture_id')) VIRTUAL,
        state TEXT GENERATED ALWAYS AS (json_extract(document, '$.state')) VIRTUAL,
        priority INTEGER GENERATED ALWAYS AS (json_extract(document, '$.priority')) VIRTUAL
    ) WITHOUT ROWID;
INSERT INTO "reconstructions" VALUES('01a20d8c-a46e-765c-b741-84ea5074fa1e','{"id":"01a20d8c-a46e-765c-b741-84ea5074fa1e","capture_id":"01a20d8c-a46e-7433-a257-359fd21d4f2b","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[]}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a46f-7202-a567-6738be8d62d9','{"id":"01a20d8c-a46f-7202-a567-6738be8d62d9","capture_id":"01a20d8c-a46e-7433-a257-359fd21d4f2b","live":false,"state":"complete","created_at":"2026-11-21T07:10:00.123456Z","options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":"2026-11-21T07:10:00.123456Z","ended_at":"2026-11-21T07:10:00.123456Z","task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[]}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a470-7111-8111-111111111111','{"id":"01a20d8c-a470-7111-8111-111111111111","capture_id":"01a20d8c-a46e-75c1-be8f-097edaace674","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"turn":"01a20d8c-a471-7222-8222-222222222222","held":false}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a471-7222-8222-222222222222','{"id":"01a20d8c-a471-7222-8222-222222222222","capture_id":"01a20d8c-a46e-75c1-be8f-097edaace674","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"turn":"01a20d8c-a470-7111-8111-111111111111","held":true}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a472-7333-8333-333333333333','{"id":"01a20d8c-a472-7333-8333-333333333333","capture_id":"01a20d8c-a46e-75c1-be8f-097edaace674","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null},"priority":7,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"turn":"","held":false}');
CREATE TABLE uploads (id TEXT PRIMARY KEY, document TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE versions (
        reconstruction_id TEXT NOT NULL, version INTEGER NOT NULL, document TEXT NOT NULL,
        PRIMARY KEY (reconstruction_id, version)
    ) WITHOUT ROWID;
INSERT INTO "versions" VALUES('01a20d8c-a46e-765c-b741-84ea5074fa1e',1,'{"reconstruction_id":"01a20d8c-a46e-765c-b741-84ea5074fa1e","version":1,"at":"2026-11-21T07:10:00.123456Z","splats":10,"poses":20,"white":0.3,"scene_bytes":1000,"psnr_db":null}');
CREATE INDEX captures_by_state ON captures (state);
CREATE INDEX reconstructions_by_capture ON reconstructions (capture_id);
CREATE INDEX reconstructions_by_state ON reconstructions (state, priority);
CREATE INDEX captures_by_group ON captures (json_extract(document, '$.group'));
CREATE INDEX reconstructions_by_state_and_age ON reconstructions (state, id);
CREATE INDEX queue_by_user ON queue (urgency, user, turn);
CREATE TRIGGER queue_follows AFTER INSERT ON reconstructions BEGIN
        DELETE FROM queue WHERE id = NEW.id;
        INSERT INTO queue SELECT -coalesce(json_extract(NEW.document, '$.priority'), 0),
            coalesce(nullif(json_extract(NEW.document, '$.turn'), ''), NEW.id), NEW.id,
            coalesce(json_extract(NEW.document, '$.held'), 0), coalesce(json_extract(NEW.document, '$.user'), '')
            WHERE json_extract(NEW.document, '$.state') = 'queued';
    END;
CREATE TRIGGER queue_forgets AFTER DELETE ON reconstructions BEGIN
        DELETE FROM queue WHERE id = OLD.id;
    END;
COMMIT;
PRAGMA user_version = 3;
